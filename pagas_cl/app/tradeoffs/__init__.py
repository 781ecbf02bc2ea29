"""What accuracy costs in time, measured: settings run on views, their errors, the Pareto front.

Flow: `study` puts together case (a view to measure on, how good a depth of it is) + run (settings, their time and
memory) -> page; one record after the other in tradeoff.json.
"""

from pagas_cl.app.tradeoffs.study import Study, tradeoff

__all__ = ["Study", "tradeoff"]

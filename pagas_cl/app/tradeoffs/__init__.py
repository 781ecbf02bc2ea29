"""What accuracy costs in time, measured: settings run on views, their errors, the Pareto front.

Flow: `study` runs settings on cases (`case`), errors, time and memory -> `page`. `costs`: how long settings will take.
"""

from pagas_cl.app.tradeoffs.study import Study, tradeoff

__all__ = ["Study", "tradeoff"]

"""What accuracy costs in time, measured: settings run on views, their errors, the Pareto front.

Flow: case (a view to measure on) + plan or ablation (settings) -> run (time, memory) -> score (errors) -> front
-> plot, page; `study` puts them together, one record after the other in tradeoff.json.
"""

from pagas_cl.tradeoffs.study import Study, tradeoff

__all__ = ["Study", "tradeoff"]

"""Figures that users know: depth and normal errors, prediction of held-out photos, Chamfer distance, F-score.

One module a figure: depth, clouds (with DTU's masks, and points of meshes and files).
"""

from pagas_cl.app.evaluate.clouds import Chamfer, FScore, VisibleSpace, chamfer, f_score, load_points, sample_surface
from pagas_cl.app.evaluate.depth import (
           DepthErrors,
           DepthReport,
           compare_depth,
           depth_per_parallax,
           dilate,
           find_discontinuities,
)
from pagas_cl.method.view.prediction import Prediction, compare_predictions, predict_photo
from pagas_cl.scene.depthmap import central_normals as depth_normals

__all__ = ["Chamfer", "DepthErrors", "DepthReport", "FScore", "Prediction", "VisibleSpace", "chamfer",
           "compare_depth", "compare_predictions", "depth_normals", "dilate", "f_score", "find_discontinuities",
           "load_points", "depth_per_parallax", "predict_photo", "sample_surface"]

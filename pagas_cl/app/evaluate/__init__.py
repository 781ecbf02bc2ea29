"""Figures that users know: depth and normal errors, Chamfer distance, F-score; and prediction of held-out photos, which
is pagas_cl.method.view.prediction.

One module a figure: depth, clouds (with DTU's masks, and points of meshes and files).
"""

"""The package's writers of other programs' formats, under the name by which tests know them."""

from pagas_cl.synthetic.exports import bundler, mvsnet, nerfstudio, neus, open3d_json, open3d_log

__all__ = ["bundler", "mvsnet", "nerfstudio", "neus", "open3d_json", "open3d_log"]

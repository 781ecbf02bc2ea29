"""Depth Anything 3 and VGGT: exports that hold all photos of a scene in one archive, or in .npy files of one folder.

Convention: z-depth; extrinsics world-to-camera (3, 4), OpenCV; intrinsics for the network's image. No names: the order
of the photos is that of their sorted paths. What these networks write for COLMAP is read as COLMAP.
"""

from dataclasses import dataclass
from pathlib import Path

from pagas_cl.errors import InputError
from pagas_cl.scene.readers import predictions
from pagas_cl.scene.view import Scene


@dataclass(frozen=True)
class Network:
    """What a network calls its arrays and where it leaves them: the first name, and the first place, that is there.

    `marks`: the arrays by which a place is recognized; `usual`: how photos come to the network's size.
    """

    name: str
    places: tuple[str, ...]
    depth: tuple[str, ...]
    pose: str
    K: str
    confidence: str
    photo: str
    marks: tuple[str, ...]
    usual: str

    @property
    def EXPECTED(self) -> str:
        return f"predictions of {self.name}: looked for {', '.join(self.marks)} in {', '.join(self.places)}"

    def detect(self, folder: Path) -> Path | None:
        """The first place that has depth and the marks."""
        for place in (folder / name for name in self.places):
            found = predictions.arrays_of(place)
            if predictions.first(found, self.depth) and all(name in found for name in self.marks):
                return place
        return None

    def read(self, folder: Path, place: Path, *, photos: Path | None = None, confidence: float | None = None) -> Scene:
        """Read the predictions; `photos`: folder of the original photos, looked for in images/ and the like by default;
        `confidence`: depths of less are left out, a quarter of the median (see depth.source) by default."""
        found = predictions.arrays_of(place)
        depth = predictions.first(found, self.depth)
        absent = [name for name in (self.pose, self.K) if name not in found]
        if depth is None or absent:
            raise InputError(f"{place} has no {[*absent, self.depth[0]][0]!r}: this model gives no cameras; take one "
                             "that does (any-view), or give cameras in another format with the depth maps as "
                             "--depth-dir")
        rows = predictions.rows_of(depth, found[self.pose], found[self.K], found.get(self.confidence),
                                   found.get(self.photo))
        source = f"{place if place != folder else folder / depth.file.name} ({self.name})"
        originals = predictions.find_photos(folder, photos and Path(photos), len(rows), source)
        return predictions.scene_of(folder, rows, originals, [f"{k:06d}.png" for k in range(len(rows))], source,
                                    usual=self.usual, least=confidence)


DEPTH_ANYTHING = Network(
    "Depth Anything 3",
    ("exports/npz/results.npz", "exports/npy", "exports/mini_npz/results.npz", "exports/mini_npy", "results.npz"),
    depth=("depth",), pose="extrinsics", K="intrinsics", confidence="conf", photo="image", marks=("depth",),
    usual="stretched")
# as people keep them: its demonstration writes a COLMAP model and no depth; photos are padded to a square, or 518 wide
VGGT = Network(
    "VGGT", ("predictions.npz", "vggt.npz", "vggt", "."), depth=("depth_map", "depth"), pose="extrinsic", K="intrinsic",
    confidence="depth_conf", photo="images", marks=("extrinsic", "intrinsic"), usual="padded")

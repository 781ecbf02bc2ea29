"""The mesh of a solid: a grid over the relief, one over each block with its walls, a tube for the bar."""

import numpy as np
from support.synthetic.solid import Bar, Block, Solid

from pagas_cl.errors import need
from pagas_cl.scene.mesh import grid_faces

_BAR_SIDES = 24
_SMOOTHINGS = 30      # Taubin's, of a clustered mesh


def solid_mesh(solid: Solid, spacing: float, half: tuple[float, float]):
    """Triangles of a solid, facing the viewers (-z): vertices float64 (n, 3), faces int32 (m, 3).

    `spacing` of vertices on the relief, scene units; `half` the part of the plane that is meshed, or the outline's half
    axes.
    """
    parts = [_relief(solid, spacing, half)]
    parts += [_block(solid, block, spacing) for block in solid.blocks]
    if solid.bar is not None:
        parts.append(_bar(solid.bar, 1.2 * float(np.hypot(*half))))
    first = np.cumsum([0, *(len(points) for points, _ in parts)])
    faces = np.concatenate([triangles + start for (_, triangles), start in zip(parts, first)])
    return np.concatenate([points for points, _ in parts]), faces.astype(np.int32)


def clustered(vertices, faces, size: float):
    """A mesh whose vertices within `size` are drawn together, smoothed: thin things go, edges are rounded. As of
    solid_mesh; needs Open3D."""
    o3d = need("open3d", "mesh", "a coarse mesh that is far off")
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces))
    mesh = mesh.simplify_vertex_clustering(size, o3d.geometry.SimplificationContraction.Average)
    mesh = mesh.filter_smooth_taubin(_SMOOTHINGS)
    mesh.remove_degenerate_triangles()
    mesh.remove_unreferenced_vertices()
    return np.array(mesh.vertices), np.array(mesh.triangles, np.int32)


def _band(near, far):
    """Triangles of a closed band between two rings of vertices."""
    next_near, next_far = np.roll(near, -1), np.roll(far, -1)
    return np.concatenate([np.stack([near, next_near, far], axis=1), np.stack([next_near, next_far, far], axis=1)])


def _relief(solid, spacing, half):
    across, down = (int(np.ceil(2 * h / spacing)) + 1 for h in half)
    u, v = np.meshgrid(np.linspace(-1, 1, across), np.linspace(-1, 1, down))
    if solid.outline is not None:  # the square onto the disc
        u, v = u * np.sqrt(1 - v**2 / 2), v * np.sqrt(1 - u**2 / 2)
    x, y = half[0] * u.ravel(), half[1] * v.ravel()
    faces = grid_faces(across, down)         # (u x v) points to -z, towards the viewers
    for block in solid.blocks:  # what lies under a block is not a surface
        along, over = block.frame(np.stack([x, y], axis=-1))
        under = (np.abs(along) < block.half_width - spacing) & (np.abs(over) < block.half_height - spacing)
        faces = faces[~under[faces].all(axis=1)]
    return np.stack([x, y, solid.height(x, y)[0]], axis=-1), faces


def _block(solid, block: Block, spacing):
    """Top as a grid; walls from its rim down to the relief."""
    across, down = (max(2, int(np.ceil(2 * h / spacing)) + 1) for h in (block.half_width, block.half_height))
    u, v = np.meshgrid(np.linspace(-block.half_width, block.half_width, across),
                       np.linspace(-block.half_height, block.half_height, down))
    c, s = np.cos(block.turn), np.sin(block.turn)
    x, y = (block.x + c * u - s * v).ravel(), (block.y + s * u + c * v).ravel()
    z = solid.height(x, y)[0]
    index = np.arange(across * down).reshape(down, across)
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    walls = _band(rim, across * down + np.arange(len(rim)))
    top = np.stack([x, y, z - block.rise], axis=-1)
    return np.concatenate([top, np.stack([x, y, z], axis=-1)[rim]]), np.concatenate([grid_faces(across, down), walls])


def _bar(bar: Bar, reach):
    axis = np.asarray(bar.direction)
    side = np.cross(axis, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    turn = 2 * np.pi * np.arange(_BAR_SIDES) / _BAR_SIDES
    # the sides' middles and corners straddle the true radius
    radius = bar.radius * 2 / (1 + np.cos(np.pi / _BAR_SIDES))
    ring = radius * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side))
    ends = [np.asarray(bar.point) + sign * reach * axis for sign in (-1, 1)]
    return np.concatenate([end + ring for end in ends]), _band(*np.arange(2 * _BAR_SIDES).reshape(2, -1))

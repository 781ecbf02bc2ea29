"""What collapsing each vertex of a mesh costs, into which neighbour, and where that goes then, in plain loops
(float64)."""

from collections import defaultdict

import numpy as np

BORDER, TURN, SLIM, LOOSE = 10.0, 0.2, 0.05, 1e-3


def quadrics(positions, unit, faces, wedges):
    """Of each vertex a symmetric 4 x 4 matrix around it, footprints, and the area that it stands for; which edges
    (u, v) lie on a border or a seam."""
    matrices, areas, seams = np.zeros((len(positions), 4, 4)), np.zeros(len(positions)), features(faces, wedges)
    for face in faces:
        a, b, c = positions[face]
        across = np.cross(b - a, c - a)
        n = across / np.linalg.norm(across)
        for k, u in enumerate(face):
            share = np.linalg.norm(across) / 6 / unit[u] ** 2
            areas[u] += share
            planes = [(n, share)]
            for v in (face[k - 2], face[k - 1]):
                if (u, v) in seams:
                    edge = positions[v] - positions[u]
                    side = np.cross(edge, n) / np.linalg.norm(edge)
                    planes.append((side, BORDER / 6 * (edge @ edge) / unit[u] ** 2))
            for normal, weight in planes:
                matrices[u, :3, :3] += weight * np.outer(normal, normal) / unit[u] ** 2
    return matrices, areas, seams


def features(faces, wedges):
    """Edges (u, v) of one triangle, or of two whose corners there are not alike."""
    sides = defaultdict(list)
    for face, corner in zip(faces.tolist(), wedges.tolist()):
        for k in range(3):
            sides[face[k], face[k - 1]].append((corner[k], corner[k - 1]))
            sides[face[k - 1], face[k]].append((corner[k - 1], corner[k]))
    return {edge for edge, found in sides.items() if len(found) == 1 or len(set(found)) > 1}


def choose(positions, unit, faces, wedges):
    """Of each vertex the costs of the neighbours that it may collapse into, by their numbers."""
    matrices, _, seams = quadrics(positions, unit, faces, wedges)
    pinned = {u for u, _ in seams}
    around = defaultdict(list)
    for face in faces.tolist():
        for k in range(3):
            around[face[k]].append((face[k], face[k - 2], face[k - 1]))
    ring = {u: {v for face in found for v in face} - {u} for u, found in around.items()}
    costs = []
    for u in range(len(positions)):
        marked = [v for v in ring[u] if (u, v) in seams]
        possible = {0: ring[u], 2: marked}.get(len(marked), ())
        costs.append({v: joined_cost(matrices[u], matrices[v], positions[v] - positions[u], v not in pinned)
                      for v in possible if may_go(positions, u, v, around, ring)})
    return costs


def joined_cost(gone, left, d, moves):
    """Of a vertex into which that of the quadric `gone` collapses, d away, where it is or, if it moves, at best."""
    both = left + around_there(gone, d)
    return cost_of(both, to_least(both) if moves else np.zeros(3))


def around_there(matrix, d):
    shift = np.eye(4)
    shift[:3, 3] = d
    return shift.T @ matrix @ shift


def to_least(matrix):
    planes = matrix[:3, :3]
    return np.linalg.solve(planes + LOOSE * np.trace(planes) * np.eye(3), -matrix[:3, 3])


def cost_of(matrix, d):
    d = np.append(d, 1.0)
    return d @ matrix @ d


def may_go(positions, u, v, around, ring):
    between = [face for face in around[u] if v in face]
    if len(ring[u] & ring[v]) != len(between):
        return False
    for _, a, b in (face for face in around[u] if v not in face):
        old, new = (np.cross(positions[a] - positions[w], positions[b] - positions[w]) for w in (u, v))
        if old @ new <= TURN * np.linalg.norm(old) * np.linalg.norm(new):
            return False
        was, slim = (height(positions[[w, a, b]]) for w in (u, v))
        if slim < min(SLIM, was):
            return False
    return True


def height(corners):
    """Over the longest edge, squared lengths."""
    a, b, c = corners
    longest = max((a - b) @ (a - b), (b - c) @ (b - c), (c - a) @ (c - a))
    return np.linalg.norm(np.cross(b - a, c - a)) / longest

"""Triangle soups and the few solids from which every object is built."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lcf3d.simulation.materials import MATERIAL_ID
from lcf3d.simulation.meshes.grids import grid_triangles

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with what a camera and a laser need to know of them.

    Attributes:
        corners: (T, 3, 3) float32 corner positions in metres.
        normals: (T, 3, 3) float32 unit normals at the corners, for smooth shading.
        uv: (T, 3, 2) float32 texture coordinates in metres.
        material: (T,) int16 index into ``MATERIALS``.
        colour: (T, 3) float32 linear RGB in [0, 1].
        seed: (T,) float32 in [0, 1), varies the pattern of facades and leaves.
    """

    corners: Floats
    normals: Floats
    uv: Floats
    material: NDArray[np.int16]
    colour: Floats
    seed: Floats

    def __len__(self) -> int:
        return len(self.corners)

    @classmethod
    def join(cls, parts: Sequence[Mesh]) -> Mesh:
        """All triangles of ``parts``, in order."""
        if not parts:
            return make_mesh(np.zeros((0, 3, 3)), "plain", (0, 0, 0))
        return cls(
            np.concatenate([p.corners for p in parts]),
            np.concatenate([p.normals for p in parts]),
            np.concatenate([p.uv for p in parts]),
            np.concatenate([p.material for p in parts]),
            np.concatenate([p.colour for p in parts]),
            np.concatenate([p.seed for p in parts]),
        )

    def bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Lowest and highest corner, (3,) each."""
        flat = self.corners.reshape(-1, 3)
        return flat.min(axis=0), flat.max(axis=0)

    def scaled(self, factors: ArrayLike) -> Mesh:
        """Stretched along the axes by (3,) positive factors."""
        f = np.asarray(factors, dtype=np.float32)
        normals = self.normals / f
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
        return replace(self, corners=self.corners * f, normals=normals)

    def moved(self, offset: ArrayLike) -> Mesh:
        """Shifted by (3,) metres."""
        return replace(self, corners=self.corners + np.asarray(offset, dtype=np.float32))

    def turned(self, rotation: ArrayLike) -> Mesh:
        """Rotated by a (3, 3) matrix."""
        r = np.asarray(rotation, dtype=np.float32).T
        # as one product of all points: numpy multiplies stacks of small matrices one by one
        corners, normals = (a.reshape(-1, 3) @ r for a in (self.corners, self.normals))
        return replace(self, corners=corners.reshape(self.corners.shape), normals=normals.reshape(self.normals.shape))

    def placed(self, x: float, y: float, z: float, yaw: float) -> Mesh:
        """Rotated about +z by ``yaw`` and then shifted."""
        return self.turned(rotation_z(yaw)).moved((x, y, z))

    def fitted(self, length: float, width: float, height: float) -> Mesh:
        """Stretched and shifted so that it exactly fills x, y in +-length/2, +-width/2 and z in 0..height."""
        low, high = self.bounds()
        size = np.array([length, width, height], dtype=np.float32)
        factors = size / np.maximum(high - low, 1e-6)
        centre = (low + high) / 2
        moved = self.moved((-centre[0], -centre[1], -low[2])).scaled(factors)
        limit = np.array([length / 2, width / 2, height], dtype=np.float32)
        lowest = np.array([-length / 2, -width / 2, 0], dtype=np.float32)
        return replace(moved, corners=np.clip(moved.corners, lowest, limit))

    def painted(self, palette: Sequence[ArrayLike]) -> Mesh:
        """Triangles marked with ``slot(k)`` get colour ``palette[k]``."""
        marked = self.colour[:, 1] < 0
        slots = np.clip(self.colour[:, 0].astype(np.int64), 0, len(palette) - 1)
        chosen = np.asarray(palette, dtype=np.float32)[slots]
        return replace(self, colour=np.where(marked[:, None], chosen, self.colour))


def slot(k: int) -> tuple[float, float, float]:
    """The mark of a colour that is chosen later, see `Mesh.painted`."""
    return float(k), -1.0, 0.0


def rotation_z(angle: float) -> NDArray[np.float64]:
    """(3, 3) counter-clockwise rotation about +z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def cross(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """Cross products along the last axis; on small arrays several times quicker than ``numpy.cross``."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1).astype(np.float64)


def face_normals(corners: NDArray[np.floating]) -> NDArray[np.float64]:
    """(T, 3) unit normals of (T, 3, 3) triangles."""
    face = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit: NDArray[np.float64] = face / np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-12)
    return unit


def make_mesh(
    corners: ArrayLike,
    material: str,
    colour: ArrayLike,
    uv: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    seed: float = 0.0,
) -> Mesh:
    """A mesh of one material and colour; normals are flat and uv planar where not given."""
    c = np.asarray(corners, dtype=np.float64).reshape(-1, 3, 3)
    n = np.asarray(np.repeat(face_normals(c)[:, None], 3, axis=1) if normals is None else normals, dtype=np.float32)
    t = len(c)
    if uv is None:
        axis = np.abs(n[:, 0]).argmax(axis=1) if t else np.zeros(0, dtype=np.int64)
        first = np.where(axis == 0, 1, 0)
        second = np.where(axis == 2, 1, 2)
        take = np.stack([first, second], axis=1)[:, None, :].repeat(3, axis=1)
        uv = np.take_along_axis(c, take, axis=2)
    return Mesh(
        c.astype(np.float32),
        n,
        np.asarray(uv, dtype=np.float32).reshape(t, 3, 2),
        np.full(t, MATERIAL_ID[material], dtype=np.int16),
        np.tile(np.asarray(colour, dtype=np.float32), (t, 1)),
        np.full(t, seed, dtype=np.float32),
    )


def quad(a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike) -> NDArray[np.float64]:
    """(2, 3, 3) the quadrilateral a, b, c, d."""
    p = [np.asarray(v, dtype=np.float64) for v in (a, b, c, d)]
    return np.array([[p[0], p[1], p[2]], [p[0], p[2], p[3]]])


def panel(a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike, material: str, colour: ArrayLike) -> Mesh:
    """A quadrilateral whose uv runs from (0, 0) at ``a`` to (1, 1) at ``c``."""
    uv = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], dtype=np.float32)
    return make_mesh(quad(a, b, c, d), material, colour, uv)


_CUBE_CORNERS = np.array(
    [[x, y, z] for z in (-0.5, 0.5) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
)
_CUBE_FACES = ((3, 2, 1, 0), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
_CUBE = np.concatenate([quad(*(_CUBE_CORNERS[i] for i in face)) for face in _CUBE_FACES])
_CUBE_NORMALS = np.repeat(face_normals(_CUBE)[:, None], 3, axis=1).astype(np.float32)
_CUBE_UV_AXES = np.array([[0, 1]] * 4 + [[0, 2]] * 2 + [[1, 2]] * 2 + [[0, 2]] * 2 + [[1, 2]] * 2)[:, None].repeat(
    3, axis=1
)


def box(centre: ArrayLike, size: ArrayLike, material: str, colour: ArrayLike, yaw: float = 0.0) -> Mesh:
    """A cuboid with its faces along the axes, turned by ``yaw`` about its own vertical axis."""
    corners = _CUBE * np.asarray(size, dtype=np.float64)
    uv = np.take_along_axis(corners, _CUBE_UV_AXES, axis=2)
    mesh = make_mesh(corners, material, colour, uv, _CUBE_NORMALS)
    return (mesh.turned(rotation_z(yaw)) if yaw else mesh).moved(centre)


def grid(
    points: NDArray[np.floating],
    material: str,
    colour: ArrayLike,
    closed: bool = False,
    crease: float = 0.75,
    uv: NDArray[np.floating] | None = None,
    seed: float = 0.0,
) -> Mesh:
    """The surface through (R, C, 3) points; ``closed`` joins the last column to the first.

    ``crease`` is the cosine of the largest angle between a face and the averaged normal that is still smooth.
    """
    p = np.asarray(points, dtype=np.float64)
    if closed:
        p = np.concatenate([p, p[:, :1]], axis=1)
    if uv is None:
        along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=2).mean(axis=1))])
        around = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=1), axis=2).mean(axis=0))])
        uv = np.stack(np.meshgrid(around, along), axis=-1)
    corners, places, normals = grid_triangles(p, np.asarray(uv, dtype=np.float64), closed, crease)
    return make_mesh(corners, material, colour, places, normals, seed)


def tube(
    points: ArrayLike, radii: ArrayLike, material: str, colour: ArrayLike, sides: int = 8, flat: float = 1.0
) -> Mesh:
    """A round bar along (K, 3) points with (K,) radii and closed ends; ``flat`` squeezes it across its run."""
    p = np.asarray(points, dtype=np.float64)
    r = np.broadcast_to(np.asarray(radii, dtype=np.float64), (len(p),))
    direction = np.gradient(p, axis=0)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    mean = direction.mean(axis=0)
    reference = np.array([0.0, 1.0, 0.0]) if abs(mean[1]) < 0.8 else np.array([1.0, 0.0, 0.0])
    side = cross(direction, np.broadcast_to(reference, direction.shape))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    up = cross(direction, side)
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = np.cos(angle)[None, :, None] * side[:, None] * flat + np.sin(angle)[None, :, None] * up[:, None]
    rings = p[:, None] + ring * r[:, None, None]
    ends = [np.repeat(p[i][None, None], sides, axis=1) for i in (0, -1)]
    return grid(np.concatenate([ends[0], rings, ends[1]]), material, colour, closed=True, crease=0.5)


def ellipsoid(centre: ArrayLike, radii: ArrayLike, material: str, colour: ArrayLike, detail: int = 8) -> Mesh:
    """An ellipsoid with its axes along x, y, z."""
    v, u = np.linspace(0, np.pi, detail), np.arange(detail + 2) * 2 * np.pi / (detail + 2)
    ring = np.stack(
        [np.sin(v)[:, None] * np.cos(u), np.sin(v)[:, None] * np.sin(u), np.repeat(np.cos(v)[:, None], len(u), 1)], -1
    )
    return grid(ring[:, ::-1] * np.asarray(radii) + np.asarray(centre), material, colour, closed=True, crease=-1.0)


def wheel(x: float, y: float, radius: float, width: float, side: float, rim_colour: ArrayLike, sides: int = 18) -> Mesh:
    """A tyre with a rim, standing on z = 0, its axle along y; ``side`` +1 or -1 tells where its outer face looks."""
    angle = np.arange(sides) * 2 * np.pi / sides
    circle = np.stack([np.cos(angle), np.zeros(sides), np.sin(angle)], axis=1)
    offset = np.array([0, 1.0, 0]) * side * width / 2
    inner, shoulder = circle * radius * 0.99 - offset, circle * radius + offset * 0.7
    rim_edge, hub = circle * radius * 0.68 + offset, circle * radius * 0.62 + offset * 0.75
    black = (0.018, 0.018, 0.018)
    order = slice(None, None, -1) if side > 0 else slice(None)
    tyre = grid(np.stack([inner * [0, 1, 0], inner, shoulder, rim_edge])[:, order], "rubber", black, closed=True)
    barrel = grid(np.stack([rim_edge, hub, hub * [0, 1, 0]])[:, order], "rubber", (0.012, 0.012, 0.012), closed=True)
    spokes = []
    for k in range(5):
        a = k * 2 * np.pi / 5
        along = np.array([np.cos(a), 0, np.sin(a)])
        across = np.array([-np.sin(a), 0, np.cos(a)]) * radius * 0.15
        at = offset * 0.98
        spokes.append(
            quad(
                at - across * 1.2,
                at + across * 1.2,
                at + along * radius * 0.66 + across,
                at + along * radius * 0.66 - across,
            )
        )
    face = make_mesh(np.concatenate(spokes), "rim", rim_colour)
    ring = grid(
        np.stack([circle * radius * 0.70 + offset * 0.99, circle * radius * 0.60 + offset * 0.99])[:, order],
        "rim",
        rim_colour,
        closed=True,
    )
    return Mesh.join([tyre, barrel, face, ring]).moved((x, y, radius))

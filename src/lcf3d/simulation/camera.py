"""A camera's image of a scene: primary, shadow and openness rays, shading, smooth edges, exposure and noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lcf3d.geometry.camera import pixel_rays, pixels_in_field
from lcf3d.geometry.epipolar import camera_centre
from lcf3d.kernels import kernel
from lcf3d.simulation.light import Light
from lcf3d.simulation.materials import camera_table
from lcf3d.simulation.meshes.primitives import Mesh
from lcf3d.simulation.photo import NEUTRAL, Photo
from lcf3d.simulation.rays import Hits, RayTracer
from lcf3d.simulation.shading import locate, shade
from lcf3d.simulation.textures import texture_ids, texture_pyramids
from lcf3d.structures import Camera

Floats = NDArray[np.float32]
_OPEN_REACH_M = 3.0
_EDGE_OFFSETS = ((-0.3, -0.17), (0.3, 0.17))


@dataclass(frozen=True, eq=False)
class Render:
    """What one camera sees.

    Attributes:
        image: (H, W, 3) uint8 RGB.
        owner: (H, W) int32 id of the actor at the centre of each pixel, 0 for scenery and sky.
        depth: (H, W) float32 distance along the camera's z axis at the centre of each pixel, inf for sky.
    """

    image: NDArray[np.uint8]
    owner: NDArray[np.int32]
    depth: Floats


@dataclass(frozen=True, eq=False)
class Stage:
    """Everything that is common to the cameras of one moment.

    Attributes:
        tracer: rays into the triangles of ``mesh``.
        mesh: triangles in the world.
        owner: (T,) int32 actor of each triangle.
        light: sun and sky.
        road: (12,) numbers of the road markings.
        world_from_lidar: (4, 4).
    """

    tracer: RayTracer
    mesh: Mesh
    owner: NDArray[np.int32]
    light: Light
    road: Floats
    world_from_lidar: NDArray[np.float64]


def camera_rays(
    camera: Camera, world_from_lidar: NDArray[np.float64], u: NDArray[np.floating], v: NDArray[np.floating]
) -> tuple[NDArray[np.float64], Floats]:
    """World position (3,) of the camera and unit directions (N, 3) through pixel positions (u, v).

    A point that projects to (u, v) belongs to pixel (floor(u), floor(v)); pixel (i, j) has its centre at
    (i + 0.5, j + 0.5). Pixels outside of a lens's field get directions on its border.
    """
    if camera.distortion is not None:
        origin = world_from_lidar[:3, :3] @ camera_centre(camera) + world_from_lidar[:3, 3]
        rays = pixel_rays(np.stack([u, v], axis=1).astype(np.float64), camera) @ world_from_lidar[:3, :3].T
        return origin, rays.astype(np.float32)
    inverse = np.linalg.inv(camera.intrinsics)
    centre = -inverse @ camera.projection[:, 3]
    world_from_camera = world_from_lidar @ np.linalg.inv(camera.camera_from_lidar)
    turn = world_from_camera[:3, :3] @ inverse
    origin = world_from_camera[:3, :3] @ centre + world_from_camera[:3, 3]
    w = turn.astype(np.float32)
    uf, vf = u.astype(np.float32), v.astype(np.float32)
    direction = np.stack([w[k, 0] * uf + w[k, 1] * vf + w[k, 2] for k in range(3)], axis=1)
    direction /= np.sqrt(np.einsum("ij,ij->i", direction, direction))[:, None]
    return origin, direction


def measure_exposure(camera: Camera, stage: Stage) -> float:
    """Exposure that brings the lower two thirds of the picture to a middle grey, from a coarse raster of rays."""
    u, v = np.meshgrid(
        np.linspace(2, camera.width - 2, 64, dtype=np.float32),
        np.linspace(camera.height / 3, camera.height - 2, 24, dtype=np.float32),
    )
    origin, direction = camera_rays(camera, stage.world_from_lidar, u.ravel(), v.ravel())
    hits = stage.tracer.first_hits(origin, direction)
    radiance, _ = _radiance(
        stage, hits, direction, origin, _forward(camera, stage), np.ones(u.size, np.float32), camera
    )
    mean = float(np.exp(np.log(np.maximum(radiance.mean(axis=1), 1e-4)).mean()))
    return float(np.clip(0.15 / mean, 0.35, 6.0 if stage.light.night > 0 else 2.5))


def _forward(camera: Camera, stage: Stage) -> NDArray[np.float64]:
    """(3,) world direction of the camera's optical axis."""
    forward: NDArray[np.float64] = stage.world_from_lidar[:3, :3] @ camera.camera_from_lidar[2, :3]
    return forward


def render(camera: Camera, stage: Stage, rng: np.random.Generator, exposure: float, photo: Photo = NEUTRAL) -> Render:
    """Image, owners and depth of one camera."""
    width, height = camera.width, camera.height
    grid_u, grid_v = np.meshgrid(np.arange(width, dtype=np.float32) + 0.5, np.arange(height, dtype=np.float32) + 0.5)
    u, v = grid_u.ravel(), grid_v.ravel()
    origin, direction = camera_rays(camera, stage.world_from_lidar, u, v)
    forward = _forward(camera, stage)
    hits = stage.tracer.first_hits(origin, direction)
    opened = _openness(stage, hits, direction, origin, width, height)
    radiance, normal = _radiance(stage, hits, direction, origin, forward, opened, camera)
    hit = hits.triangle >= 0
    cosine = direction @ forward.astype(np.float32)
    depth = np.where(hit, hits.distance * cosine, np.inf).astype(np.float32)
    owner = np.where(hit, stage.owner[hits.triangle], 0).astype(np.int32)
    edge = np.flatnonzero(
        find_edges(
            hits.triangle.reshape(height, width),
            stage.mesh.material,
            owner.reshape(height, width),
            normal.reshape(height, width, 3),
            depth.reshape(height, width),
        )
    )
    if len(edge):
        radiance[edge] = _smooth(stage, camera, u, v, edge, opened, forward, radiance[edge])
    image = develop(radiance.reshape(height, width, 3), rng, exposure, stage.light.night > 0, photo)
    if camera.distortion is not None:
        black = ~pixels_in_field(np.stack([u, v], axis=1).astype(np.float64), camera)
        owner[black], depth[black] = 0, np.inf
        image[black.reshape(height, width)] = 0
    return Render(image, owner.reshape(height, width), depth.reshape(height, width))


def _smooth(
    stage: Stage,
    camera: Camera,
    u: Floats,
    v: Floats,
    edge: NDArray[np.int64],
    opened: Floats,
    forward: NDArray[np.float64],
    centre: Floats,
) -> Floats:
    """Radiance of the pixels at edges, averaged over two more rays each."""
    total = centre.copy()
    for du, dv in _EDGE_OFFSETS:
        origin, direction = camera_rays(
            camera, stage.world_from_lidar, u[edge] + np.float32(du), v[edge] + np.float32(dv)
        )
        hits = stage.tracer.first_hits(origin, direction)
        extra, _ = _radiance(stage, hits, direction, origin, forward, opened[edge], camera)
        total += np.minimum(extra, 4.0)
    return total / np.float32(1 + len(_EDGE_OFFSETS))


@lru_cache(maxsize=1)
def _material_table() -> Floats:
    return camera_table(texture_ids())


def _radiance(
    stage: Stage,
    hits: Hits,
    direction: Floats,
    origin: NDArray[np.float64],
    forward: NDArray[np.float64],
    opened: Floats,
    camera: Camera,
) -> tuple[Floats, Floats]:
    """(N, 3) linear radiance and (N, 3) normals of rays."""
    n, mesh, light = len(direction), stage.mesh, stage.light
    position, normal = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
    facing = np.zeros(n, dtype=np.bool_)
    start = origin.astype(np.float32)
    locate(
        hits.triangle,
        hits.u,
        hits.v,
        hits.distance,
        direction,
        start,
        mesh.corners,
        mesh.normals,
        light.sun.astype(np.float32),
        position,
        normal,
        facing,
    )
    lit = np.zeros(n, dtype=np.float32)
    which = np.flatnonzero(facing)
    if light.sun_colour.max() > 0.005:
        lit[which] = ~stage.tracer.is_blocked(position[which], np.broadcast_to(light.sun, (len(which), 3)))
    out = np.empty((n, 3), dtype=np.float32)
    shade(
        hits.triangle,
        hits.u,
        hits.v,
        hits.distance,
        direction,
        position,
        normal,
        lit,
        opened,
        mesh.uv,
        mesh.material,
        mesh.colour,
        mesh.seed,
        _material_table(),
        texture_pyramids(),
        stage.road,
        light.sky,
        light.numbers(origin, forward),
        np.float32(1 / camera.intrinsics[0, 0]),
        out,
    )
    return out, normal


@lru_cache(maxsize=1)
def _open_directions() -> Floats:
    """(16, 3) cosine-weighted directions of the upper half sphere, one for each pixel of a 4 x 4 tile."""
    k = np.arange(16)
    radius, angle = np.sqrt((k + 0.5) / 16), k * 2.399963
    order = np.array([0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5])
    result = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1)
    ordered: Floats = result[order].astype(np.float32)
    return ordered


def _openness(
    stage: Stage, hits: Hits, direction: Floats, origin: NDArray[np.float64], width: int, height: int
) -> Floats:
    """(N,) open share of the near surroundings, from a short ray for every fourth pixel, smoothed within surfaces."""
    rows, columns = np.arange(0, height, 2), np.arange(0, width, 2)
    pick = (rows[:, None] * width + columns[None, :]).ravel()
    triangle = hits.triangle[pick]
    n = len(pick)
    position, normal = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
    facing = np.zeros(n, dtype=np.bool_)
    locate(
        triangle,
        hits.u[pick],
        hits.v[pick],
        hits.distance[pick],
        direction[pick],
        origin.astype(np.float32),
        stage.mesh.corners,
        stage.mesh.normals,
        np.zeros(3, np.float32),
        position,
        normal,
        facing,
    )
    tile = ((rows[:, None] // 2 % 4) * 4 + columns[None, :] // 2 % 4).ravel()
    local = _open_directions()[tile]
    which = np.flatnonzero((triangle >= 0) & (hits.distance[pick] < 80))
    rays = _around(normal[which], local[which])
    blocked = np.zeros(n, dtype=np.float32)
    blocked[which] = stage.tracer.is_blocked(position[which], rays, _OPEN_REACH_M)
    shape = (len(rows), len(columns))
    distance = np.where(triangle >= 0, hits.distance[pick], 1e4).astype(np.float32)
    full = np.where(hits.triangle >= 0, hits.distance, 1e4).astype(np.float32).reshape(height, width)
    out = np.empty((height, width), dtype=np.float32)
    spread_openness(blocked.reshape(shape), distance.reshape(shape), normal.reshape(*shape, 3), full, out)
    return out.ravel()


def _around(normal: Floats, local: Floats) -> Floats:
    """(N, 3) ``local`` directions turned so that their z axis is the normal (Duff et al. 2017, building a basis)."""
    nx, ny, nz = normal.T
    sign = np.where(nz >= 0, np.float32(1), np.float32(-1))
    a = -1 / (sign + nz)
    b = nx * ny * a
    first = np.stack([1 + sign * nx * nx * a, sign * b, -sign * nx], axis=1)
    second = np.stack([b, sign + ny * ny * a, -ny], axis=1)
    result: Floats = local[:, :1] * first + local[:, 1:2] * second + local[:, 2:] * normal
    return result


@kernel
def spread_openness(blocked, distance, normal, full, out):  # type: ignore[no-untyped-def]
    """Average half-resolution samples over 8 x 8 neighbours on the same surface, and bring them to full resolution."""
    h, w = blocked.shape
    half = np.empty((h, w), np.float32)
    for i in range(h):
        for j in range(w):
            total, weight = 0.0, 0.0
            d = distance[i, j]
            for a in range(max(i - 4, 0), min(i + 4, h)):
                for b in range(max(j - 4, 0), min(j + 4, w)):
                    if abs(distance[a, b] - d) < 0.06 * d:
                        same = (
                            normal[a, b, 0] * normal[i, j, 0]
                            + normal[a, b, 1] * normal[i, j, 1]
                            + normal[a, b, 2] * normal[i, j, 2]
                        )
                        if same > 0.7:
                            total += blocked[a, b]
                            weight += 1.0
            half[i, j] = 1.0 - total / max(weight, 10.0)  # thin things have too few samples to be sure of
    for i in range(full.shape[0]):
        for j in range(full.shape[1]):
            best, value = 1e9, 1.0
            for a in range(i // 2, min(i // 2 + 2, h)):
                for b in range(j // 2, min(j // 2 + 2, w)):
                    gap = abs(distance[a, b] - full[i, j])
                    if gap < best:
                        best, value = gap, half[a, b]
            out[i, j] = value


@kernel
def find_edges(triangle, material, owner, normal, depth):  # type: ignore[no-untyped-def]
    """(H, W) bool: pixels whose right or lower neighbour is another surface, and those neighbours."""
    h, w = triangle.shape
    edge = np.zeros((h, w), np.bool_)
    for i in range(h):
        for j in range(w):
            for a, b in ((i, j + 1), (i + 1, j)):
                if a >= h or b >= w or triangle[i, j] == triangle[a, b]:
                    continue
                p, q = triangle[i, j], triangle[a, b]
                if p < 0 or q < 0 or owner[i, j] != owner[a, b] or material[p] != material[q]:
                    edge[i, j] = edge[a, b] = True
                    continue
                same = (
                    normal[i, j, 0] * normal[a, b, 0]
                    + normal[i, j, 1] * normal[a, b, 1]
                    + normal[i, j, 2] * normal[a, b, 2]
                )
                if same < 0.85 or abs(depth[i, j] - depth[a, b]) > 0.05 * min(depth[i, j], depth[a, b]):
                    edge[i, j] = edge[a, b] = True
    return edge


def develop(
    radiance: Floats, rng: np.random.Generator, exposure: float, night: bool, photo: Photo = NEUTRAL
) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 from linear radiance: exposure, the look of ``photo``, film curve, sensor noise, sRGB."""
    x = radiance * np.float32(exposure * photo.exposure)
    if photo != NEUTRAL:
        x = photo.apply(x)
    noise = rng.standard_normal(x.shape, dtype=np.float32)
    grain = np.float32(photo.noise * (2.0 if night else 1.0))
    image: NDArray[np.uint8] = _expose(x, noise, grain, _film_table())
    return image


@kernel
def _expose(x, noise, grain, table):  # type: ignore[no-untyped-def]
    """Colours a little stronger, noise, and the film curve of (H, W, 3) exposed values; in single precision."""
    image = np.empty(x.shape, np.uint8)
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            grey = (x[i, j, 0] + x[i, j, 1] + x[i, j, 2]) / np.float32(3)
            for k in range(3):
                value = max(grey + (x[i, j, k] - grey) * np.float32(1.12), np.float32(0))
                spread = np.float32(0.004) + np.float32(0.012) * np.sqrt(value)
                value = max(value + noise[i, j, k] * spread * grain, np.float32(0))
                place = np.sqrt(value * np.float32(0.125)) * np.float32(4096)
                image[i, j, k] = table[int(min(place, np.float32(4095)))]
    return image


@lru_cache(maxsize=1)
def _film_table() -> NDArray[np.uint8]:
    """The film curve tabulated over the square root, so that the shadows get enough entries."""
    root = (np.arange(4096) + 0.5) / 4096
    x = root**2 * 8.0
    curve = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    curve = np.clip(curve * 1.04 - 0.004, 0, 1)
    srgb = np.where(curve < 0.0031308, 12.92 * curve, 1.055 * curve ** (1 / 2.4) - 0.055)
    return np.round(srgb * 255).astype(np.uint8)

"""A spinning LiDAR in a scene: beams in firing order; surfaces that swallow, mirror or let them pass; noise, rain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lcf3d.kernels import kernel
from lcf3d.simulation.camera import Stage
from lcf3d.simulation.materials import lidar_table
from lcf3d.simulation.patterns import facade, road_mark
from lcf3d.simulation.presets import LidarSpec
from lcf3d.simulation.rays import Hits
from lcf3d.simulation.response import respond

Floats = NDArray[np.float32]
_GLASS_PASSES = 3


@dataclass(frozen=True, eq=False)
class Scan:
    """One turn of the LiDAR, moved to where the sensor is at the middle of the turn.

    Attributes:
        points: (N, 4) float32 x, y, z (LiDAR frame, x forward, y left, z up) and intensity in [0, 1], ring by ring
            from the top ring down, each in firing order.
        ring: (N,) int32, 0 for the lowest beam.
        owner: (N,) int32 id of the actor that sent the beam back, 0 for scenery.
    """

    points: Floats
    ring: NDArray[np.int32]
    owner: NDArray[np.int32]


@lru_cache(maxsize=4)
def beam_directions(spec: LidarSpec) -> tuple[Floats, NDArray[np.int32], Floats]:
    """(N, 3) unit directions in the LiDAR frame, (N,) ring, and (N,) time of firing in seconds from mid-turn.

    Beams run ring by ring from the top, within a ring clockwise from straight behind.
    """
    rings = np.arange(len(spec.elevations_deg) - 1, -1, -1)
    share = (np.arange(spec.steps) + 0.5) / spec.steps
    offset = ((rings * 0.618034) % 1.0 - 0.5) / spec.steps  # lasers do not fire at the same moment
    azimuth = np.pi - 2 * np.pi * (share[None, :] + offset[:, None])
    elevation = np.radians(np.array(spec.elevations_deg)[rings])[:, None]
    direction = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth],
        axis=-1,
    )
    time = np.broadcast_to((share - 0.5) / spec.rate_hz, azimuth.shape)
    ring = np.broadcast_to(rings[:, None], azimuth.shape)
    return (
        direction.reshape(-1, 3).astype(np.float32),
        ring.ravel().astype(np.int32),
        time.ravel().astype(np.float32),
    )


def scan(spec: LidarSpec, stage: Stage, velocity: tuple[float, float], rain: float, rng: np.random.Generator) -> Scan:
    """A turn of the LiDAR while the car travels with ``velocity`` (world m/s); the rest of the scene stands still.

    Points are compensated for the car's own motion, as KITTI's and nuScenes' are.
    """
    local, ring, time = beam_directions(spec)
    rotation = stage.world_from_lidar[:3, :3].astype(np.float32)
    direction = local @ rotation.T
    centre = stage.world_from_lidar[:3, 3].astype(np.float32)
    shift = np.array([velocity[0], velocity[1], 0.0], dtype=np.float32)
    origin = centre + time[:, None] * shift
    hits = stage.tracer.first_hits(origin, direction)
    triangle, distance, u, v = hits.triangle.copy(), hits.distance.copy(), hits.u.copy(), hits.v.copy()
    chance = rng.random((len(direction), 3), dtype=np.float32)
    _through_glass(stage, origin, direction, triangle, distance, u, v, chance[:, 0])
    mesh = stage.mesh
    intensity = np.empty(len(direction), dtype=np.float32)
    kept = np.empty(len(direction), dtype=np.bool_)
    reflect(
        triangle,
        distance,
        u,
        v,
        direction,
        mesh.corners,
        mesh.uv,
        mesh.material,
        mesh.colour,
        mesh.seed,
        lidar_table(),
        stage.road,
        chance,
        spec.sensitivity * (1.0 - 0.45 * rain),
        spec.base_loss,
        0.012 * rain,
        intensity,
        kept,
    )
    noise = rng.standard_normal((len(direction), 2), dtype=np.float32)
    measured = distance + noise[:, 0] * np.float32(spec.noise_m)
    if spec.uneven_beams:
        material = mesh.material[np.maximum(triangle, 0)]
        intensity = respond(intensity, material, ring, len(spec.elevations_deg), rng)
    owner = np.where(triangle >= 0, stage.owner[triangle], 0).astype(np.int32)
    if rain:
        _droplets(rain, measured, intensity, kept, owner, rng)
    kept &= (measured > spec.min_range_m) & (measured < spec.max_range_m)
    intensity = np.clip(intensity * (1 + 0.10 * noise[:, 1]), 0, 0.99)
    local_points = local * measured[:, None] + (time[:, None] * shift) @ rotation
    points = np.concatenate([local_points, np.round(intensity, 2)[:, None]], axis=1).astype(np.float32)
    return Scan(points[kept], ring[kept], owner[kept])


def _through_glass(
    stage: Stage,
    origin: Floats,
    direction: Floats,
    triangle: NDArray[np.int32],
    distance: Floats,
    u: Floats,
    v: Floats,
    chance: Floats,
) -> None:
    """Beams that meet glass: one in ten comes back, half are mirrored away, the others go on to what lies behind."""
    glass = lidar_table()[:, 3] > 0
    for _ in range(_GLASS_PASSES):
        here = np.flatnonzero(triangle >= 0)
        here = here[glass[stage.mesh.material[triangle[here]]]]
        here = here[chance[here] >= 0.10]
        lost = chance[here] < 0.60
        triangle[here[lost]] = -1
        here = here[~lost]
        if not len(here):
            return
        step = distance[here] + np.float32(0.01)
        behind: Hits = stage.tracer.first_hits(origin[here] + direction[here] * step[:, None], direction[here])
        triangle[here], distance[here], u[here], v[here] = behind.triangle, behind.distance + step, behind.u, behind.v


def _droplets(
    rain: float,
    measured: Floats,
    intensity: Floats,
    kept: NDArray[np.bool_],
    owner: NDArray[np.int32],
    rng: np.random.Generator,
) -> None:
    """Beams that a raindrop near the sensor sends back."""
    n = len(measured)
    hit = np.flatnonzero(rng.random(n, dtype=np.float32) < 0.012 * rain)
    near = (1.5 + rng.exponential(3.5, len(hit))).astype(np.float32)
    first = near < np.where(kept[hit], measured[hit], np.inf)
    chosen = hit[first]
    measured[chosen], intensity[chosen], kept[chosen], owner[chosen] = near[first], 0.02, True, 0


@kernel(inline="always")
def incidence(corners, direction):  # type: ignore[no-untyped-def]
    """Cosine of the angle between a beam (3,) and the normal of a triangle (3, 3), whichever side it hits."""
    ax, ay, az = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1], corners[1, 2] - corners[0, 2]
    bx, by, bz = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1], corners[2, 2] - corners[0, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-20
    return abs(nx * direction[0] + ny * direction[1] + nz * direction[2]) / length


@kernel
def reflect(  # type: ignore[no-untyped-def]
    triangle,
    distance,
    u,
    v,
    direction,
    corners,
    uv,
    material,
    colour,
    seed,
    table,
    road,
    chance,
    sensitivity,
    base_loss,
    fog,
    intensity,
    kept,
):
    """Intensity of N beams and whether they come back, into ``intensity`` and ``kept`` (N,)."""
    scratch = np.empty(3, np.float32)
    for i in range(len(triangle)):
        t = triangle[i]
        kept[i] = False
        intensity[i] = 0.0
        if t < 0:
            continue
        m = material[t]
        cosine = incidence(corners[t], direction[i])
        light = 0.3 * colour[t, 0] + 0.6 * colour[t, 1] + 0.1 * colour[t, 2]
        influence = table[m, 1]
        reflectance = table[m, 0] * (1 - influence + influence * min(max(2.2 * math.sqrt(light), 0.12), 1.5))
        w = 1.0 - u[i] - v[i]
        s = w * uv[t, 0, 0] + u[i] * uv[t, 1, 0] + v[i] * uv[t, 2, 0]
        r = w * uv[t, 0, 1] + u[i] * uv[t, 1, 1] + v[i] * uv[t, 2, 1]
        if table[m, 4] == 3:
            reflectance += 0.45 * road_mark(s, r, road, 0.05)
        elif table[m, 4] == 4:
            window = facade(s, r, seed[t], 0.01, 0.0, scratch)
            if window > 0.5:
                if chance[i, 0] < 0.55:
                    continue
                reflectance *= 0.4
        elif table[m, 4] == 6:
            cosine = 0.35 + 0.65 * cosine
            reflectance *= 0.6 + 0.8 * seed[t]
        value = 1.35 * reflectance * (0.60 + 0.40 * cosine)
        faint = 0.30 if table[m, 4] == 6 else 0.09
        if table[m, 2] > 0:
            value = min(0.99, value * (1 + table[m, 2] * cosine * cosine))
        clear = sensitivity * reflectance * (0.12 + 0.88 * cosine) / (distance[i] * distance[i])
        signal = clear * math.exp(-2 * fog * distance[i])
        if chance[i, 1] < base_loss or chance[i, 2] > 1 - math.exp(-signal * 4):
            continue
        kept[i] = True
        # real scanners give part of their returns, most of all from leaves, an intensity of zero
        intensity[i] = 0.0 if chance[i, 0] > 1 - faint else value * (0.85 + 0.3 * chance[i, 2])

"""Embree's own C interface, in the library that the package embreex brings along.

embreex copies triangles number by number through Python objects, which takes four times as long as building the search
tree; the library itself takes them as they lie in memory. Results are the same to the bit.
"""

from __future__ import annotations

import ctypes
import weakref
from ctypes.util import find_library
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from lcf3d.kernels import kernel

Floats = NDArray[np.float32]

# numbers of rtcore_common.h, rtcore_buffer.h, rtcore_geometry.h and rtcore_scene.h
_TRIANGLES, _INDICES, _VERTICES = 0, 0, 1
_FLOAT3, _UINT3 = 0x9003, 0x5003
_ROBUST = 4
_POINTER = ctypes.c_void_p
_FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "rtcNewDevice": (_POINTER, [ctypes.c_char_p]),
    "rtcNewScene": (_POINTER, [_POINTER]),
    "rtcSetSceneFlags": (None, [_POINTER, ctypes.c_int]),
    "rtcNewGeometry": (_POINTER, [_POINTER, ctypes.c_int]),
    "rtcSetSharedGeometryBuffer": (
        None,
        [_POINTER, ctypes.c_int, ctypes.c_uint, ctypes.c_int, _POINTER, *[ctypes.c_size_t] * 3],
    ),
    "rtcCommitGeometry": (None, [_POINTER]),
    "rtcAttachGeometry": (ctypes.c_uint, [_POINTER, _POINTER]),
    "rtcReleaseGeometry": (None, [_POINTER]),
    "rtcCommitScene": (None, [_POINTER]),
    "rtcReleaseScene": (None, [_POINTER]),
}
_QUERY = types.void(types.intp, types.intp, types.intp)
_intersect = types.ExternalFunction("rtcIntersect1", _QUERY)
_occluded = types.ExternalFunction("rtcOccluded1", _QUERY)
_NONE = np.uint32(0xFFFFFFFF)
_FAR = 1e37


@lru_cache(maxsize=1)
def library() -> Any | None:
    """Embree 4 as embreex brings it or as it is installed; None where there is none."""
    import embreex
    from llvmlite.binding import add_symbol

    package = Path(embreex.__file__).parent
    beside = [*package.parent.glob("embreex.libs/*embree4*"), *package.glob(".dylibs/*embree4*")]
    for path in [*map(str, beside), find_library("embree4")]:
        try:
            loaded = ctypes.CDLL(path) if path else None
            if loaded is None:
                continue
            for name, (result, arguments) in _FUNCTIONS.items():
                function = getattr(loaded, name)
                function.restype, function.argtypes = result, arguments
            for name in ("rtcIntersect1", "rtcOccluded1"):
                add_symbol(name, ctypes.cast(getattr(loaded, name), _POINTER).value)
        except (OSError, AttributeError):
            continue
        return loaded
    return None


@lru_cache(maxsize=1)
def _device() -> int:
    """One device a process; trees are built in the thread that asks for them, processes being many already."""
    loaded = library()
    assert loaded is not None
    return int(loaded.rtcNewDevice(b"threads=1"))


class Tree:
    """A search tree of triangles.

    Args:
        corners: (T, 3, 3) float32, C-contiguous; must not be changed afterwards.
    """

    def __init__(self, corners: Floats) -> None:
        loaded = library()
        assert loaded is not None
        # vertices are read 16 bytes at a time: the last one needs room behind it
        vertices = np.concatenate([corners.ravel(), np.zeros(4, np.float32)])
        indices = np.arange(3 * len(corners), dtype=np.uint32)
        self.scene = int(loaded.rtcNewScene(_device()))
        weakref.finalize(self, loaded.rtcReleaseScene, self.scene)
        self._kept = (vertices, indices)
        loaded.rtcSetSceneFlags(self.scene, _ROBUST)
        geometry = loaded.rtcNewGeometry(_device(), _TRIANGLES)
        buffers = ((_VERTICES, _FLOAT3, vertices, 3 * len(corners)), (_INDICES, _UINT3, indices, len(corners)))
        for kind, form, values, count in buffers:
            loaded.rtcSetSharedGeometryBuffer(geometry, kind, 0, form, values.ctypes.data, 0, 12, count)
        loaded.rtcCommitGeometry(geometry)
        loaded.rtcAttachGeometry(self.scene, geometry)
        loaded.rtcReleaseGeometry(geometry)
        loaded.rtcCommitScene(self.scene)

    def first_hits(self, origins: Floats, directions: Floats) -> tuple[NDArray[np.int32], Floats, Floats, Floats]:
        """Triangle (-1 for none), distance, u and v of the first hits from (1, 3) or (N, 3) along (N, 3)."""
        count = len(directions)
        triangle = np.empty(count, dtype=np.int32)
        distance, u, v = (np.empty(count, dtype=np.float32) for _ in range(3))
        _trace(self.scene, origins, directions, triangle, distance, u, v)
        return triangle, distance, u, v

    def is_blocked(self, origins: Floats, directions: Floats, reach_m: float) -> NDArray[np.bool_]:
        """(N,) whether anything lies within ``reach_m`` from (1, 3) or (N, 3) along (N, 3)."""
        blocked = np.empty(len(directions), dtype=np.bool_)
        _block(self.scene, origins, directions, np.float32(reach_m), blocked)
        return blocked


@kernel(inline="always")
def _set_out(ray, ints, origin, direction, reach):  # type: ignore[no-untyped-def]
    """Fill an RTCRay: origin, near end, direction, time, far end, mask, id, flags."""
    ray[0], ray[1], ray[2], ray[3] = origin[0], origin[1], origin[2], 0.0
    ray[4], ray[5], ray[6], ray[7] = direction[0], direction[1], direction[2], 0.0
    ray[8] = reach
    ints[9], ints[10], ints[11] = _NONE, 0, 0


@kernel
def _trace(scene, origins, directions, triangle, distance, u, v):  # type: ignore[no-untyped-def]
    """First hits of N rays: an RTCRayHit of 16-byte alignment is filled and asked for each."""
    room = np.zeros(40, np.float32)
    start = (-room.ctypes.data % 16) // 4
    ray = room[start : start + 32]
    ints = ray.view(np.uint32)
    for i in range(len(directions)):
        _set_out(ray, ints, origins[min(i, len(origins) - 1)], directions[i], _FAR)
        ray[15], ray[16] = 0.0, 0.0
        ints[17], ints[18], ints[19], ints[20] = _NONE, _NONE, _NONE, _NONE
        _intersect(scene, ray.ctypes.data, 0)
        triangle[i] = np.int32(ints[17])
        distance[i], u[i], v[i] = ray[8], ray[15], ray[16]


@kernel
def _block(scene, origins, directions, reach, blocked):  # type: ignore[no-untyped-def]
    """Whether N rays meet anything: the far end of an RTCRay that does becomes negative."""
    room = np.zeros(24, np.float32)
    start = (-room.ctypes.data % 16) // 4
    ray = room[start : start + 16]
    ints = ray.view(np.uint32)
    for i in range(len(directions)):
        _set_out(ray, ints, origins[min(i, len(origins) - 1)], directions[i], reach)
        _occluded(scene, ray.ctypes.data, 0)
        blocked[i] = ray[8] < 0

"""Embree 4 through ctypes: the library inside embreex's wheel.

embreex's own interface casts single rays. The library can do more: coherent packets of 4, 8 or 16 rays. The names and
numbers are those of Embree's public header `rtcore.h`.
"""

import ctypes
from functools import lru_cache
from importlib import util
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.raycast.base import EngineUnavailable, Solid

_ANY_RAY = 0xFFFFFFFF
INVALID = 0xFFFFFFFF

RAY_ROWS = 21
"""Rows of a packet: 12 of the ray, then normal x y z, u, v, primitive, geometry, instance and its primitive."""

_FORMAT_UINT3, _FORMAT_FLOAT3 = 0x5003, 0x9003
_BUFFER_INDEX, _BUFFER_VERTEX = 0, 1
_TRIANGLE = 0
_SCENE_ROBUST = 1 << 2
"""Robust: watertight at shared edges, for an eighth of the speed."""
_VERSION = 0
_NATIVE_WIDTHS = {16: 34, 8: 33, 4: 32}
_COHERENT = 1 << 16
_ALL_FEATURES = 0xFFFFFFFF
_FOLDERS = ("../embreex.libs", ".dylibs", "../embreex.dylibs")
_NAMES = ("libembree4*.so*", "libembree4*.dylib", "embree4*.dll")

_POINTER, _UINT, _INT = ctypes.c_void_p, ctypes.c_uint, ctypes.c_int
_SIGNATURES: dict[str, tuple[type | None, tuple[type, ...]]] = {
    "rtcNewDevice": (_POINTER, (ctypes.c_char_p,)),
    "rtcGetDeviceProperty": (ctypes.c_ssize_t, (_POINTER, _INT)),
    "rtcGetDeviceError": (_INT, (_POINTER,)),
    "rtcNewScene": (_POINTER, (_POINTER,)),
    "rtcReleaseScene": (None, (_POINTER,)),
    "rtcSetSceneFlags": (None, (_POINTER, _INT)),
    "rtcCommitScene": (None, (_POINTER,)),
    "rtcNewGeometry": (_POINTER, (_POINTER, _INT)),
    "rtcReleaseGeometry": (None, (_POINTER,)),
    "rtcCommitGeometry": (None, (_POINTER,)),
    "rtcSetGeometryMask": (None, (_POINTER, _UINT)),
    "rtcAttachGeometryByID": (None, (_POINTER, _POINTER, _UINT)),
    "rtcSetSharedGeometryBuffer": (
        None,
        (_POINTER, _INT, _UINT, _INT, _POINTER, ctypes.c_size_t, ctypes.c_size_t, ctypes.c_size_t),
    ),
    "rtcIntersect4": (None, (_POINTER,) * 4),
    "rtcIntersect8": (None, (_POINTER,) * 4),
    "rtcIntersect16": (None, (_POINTER,) * 4),
}


class _IntersectArguments(ctypes.Structure):
    _fields_ = (
        ("flags", ctypes.c_uint),
        ("feature_mask", ctypes.c_uint),
        ("context", ctypes.c_void_p),
        ("filter", ctypes.c_void_p),
        ("intersect", ctypes.c_void_p),
        ("min_width_distance_factor", ctypes.c_float),
    )


class Library:
    """The loaded library and one device.

    Attributes:
        api: its functions.
        device: handle.
        width: of the widest packet that runs natively; a wider one would be emulated by single rays.
        intersect: address of the function that traces one packet of that width.
        arguments: address of its arguments: coherent rays.
    """

    def __init__(self, path: Path) -> None:
        """Load the library; `EngineUnavailable` when it is another version or cannot be loaded."""
        try:
            self.api = ctypes.CDLL(str(path))
            for name, (result, arguments) in _SIGNATURES.items():
                function = getattr(self.api, name)
                function.restype, function.argtypes = result, arguments
        except (OSError, AttributeError) as error:
            raise EngineUnavailable(f"{path.name} cannot be loaded: {error}") from None
        self.device = self.api.rtcNewDevice(None)
        if not self.device:
            raise EngineUnavailable(f"{path.name} opens no device")
        version = self.api.rtcGetDeviceProperty(self.device, _VERSION)
        if version // 10_000 != 4:
            raise EngineUnavailable(f"{path.name} is Embree {version}, not 4.x")
        native = [w for w, key in _NATIVE_WIDTHS.items() if self.api.rtcGetDeviceProperty(self.device, key)]
        if not native:
            raise EngineUnavailable(f"{path.name} traces no packets natively")
        self.width = max(native)
        self.intersect = self.address(f"rtcIntersect{self.width}")
        self._arguments = _IntersectArguments(flags=_COHERENT, feature_mask=_ALL_FEATURES)
        self.arguments = ctypes.addressof(self._arguments)

    def address(self, name: str) -> int:
        """Return the address of a function, for compiled code."""
        return ctypes.cast(getattr(self.api, name), ctypes.c_void_p).value or 0

    def check(self) -> None:
        """Raise RuntimeError when the device has reported an error since the last check."""
        code = self.api.rtcGetDeviceError(self.device)
        if code:
            raise RuntimeError(f"Embree reports error {code}")


@lru_cache(maxsize=1)
def library() -> Library:
    """Return the library of embreex's wheel, loaded once; `EngineUnavailable` when missing."""
    package = util.find_spec("embreex")
    if package is None or package.origin is None:
        raise EngineUnavailable("embreex is not installed")
    home = Path(package.origin).parent
    found = [path for folder in _FOLDERS for name in _NAMES for path in sorted((home / folder).glob(name))]
    if not found:
        raise EngineUnavailable("embreex's wheel carries no Embree library")
    return Library(found[0])


class Hierarchy:
    """Committed Embree scene of one solid."""

    def __init__(self, solid: Solid) -> None:
        """Build it; the solid's arrays are copied because Embree reads 4 bytes beyond the last vertex."""
        lib = library()
        self._lib = lib
        self._vertices = np.concatenate([solid.vertices, np.zeros((1, 3), np.float32)]).astype(np.float32)
        self._faces = np.ascontiguousarray(solid.faces, np.uint32)
        self.material: NDArray[np.uint8] = np.ascontiguousarray(solid.material, np.uint8)
        self.handle: int = lib.api.rtcNewScene(lib.device)
        lib.api.rtcSetSceneFlags(self.handle, _SCENE_ROBUST)
        if len(self._faces):
            geometry = lib.api.rtcNewGeometry(lib.device, _TRIANGLE)
            share, vertices, faces = lib.api.rtcSetSharedGeometryBuffer, self._vertices, self._faces
            share(geometry, _BUFFER_VERTEX, 0, _FORMAT_FLOAT3, vertices.ctypes.data, 0, 12, len(vertices) - 1)
            share(geometry, _BUFFER_INDEX, 0, _FORMAT_UINT3, faces.ctypes.data, 0, 12, len(faces))
            # Without this a geometry is seen by the rays of mask 1 only.
            lib.api.rtcSetGeometryMask(geometry, _ANY_RAY)
            lib.api.rtcCommitGeometry(geometry)
            lib.api.rtcAttachGeometryByID(self.handle, geometry, 0)
            lib.api.rtcReleaseGeometry(geometry)
        lib.api.rtcCommitScene(self.handle)
        lib.check()

    def __del__(self) -> None:
        if handle := getattr(self, "handle", None):
            self._lib.api.rtcReleaseScene(handle)

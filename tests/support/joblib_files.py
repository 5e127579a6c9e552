"""Files as joblib.dump writes them: pickles with the bytes of arrays between their operations."""

import io
import pickle
import sys
import types
import zlib

import numpy as np

_ALIGNMENT = 16


class NumpyArrayWrapper:
    """Stands for an array, whose bytes follow."""


NumpyArrayWrapper.__module__ = "joblib.numpy_pickle"


class _Pickler(pickle._Pickler):  # pyright: ignore[reportAttributeAccessIssue]
    def __init__(self, stream: io.BytesIO, protocol: int) -> None:
        super().__init__(stream, protocol)
        self._stream = stream

    def save(self, obj: object, save_persistent_id: bool = True) -> None:
        if type(obj) is not np.ndarray:
            return super().save(obj, save_persistent_id)
        wrapper = NumpyArrayWrapper()
        by_columns = obj.flags.f_contiguous and not obj.flags.c_contiguous
        wrapper.__dict__.update(
            subclass=np.ndarray, shape=obj.shape, order="F" if by_columns else "C", dtype=obj.dtype, allow_mmap=True,
            numpy_array_alignment_bytes=_ALIGNMENT,
        )  # fmt: skip
        super().save(wrapper)
        if self.proto >= 4:
            self.framer.commit_frame(force=True)
        padding = _ALIGNMENT - (self._stream.tell() + 1) % _ALIGNMENT
        self._stream.write(bytes([padding]) + b"\xff" * padding)
        self._stream.write(obj.tobytes("F" if by_columns else "C"))
        return None


def dumped(content: object, compressed: bool = False, protocol: int = 4) -> bytes:
    """What joblib.dump writes of dictionaries, lists and arrays."""
    name, stream = "joblib.numpy_pickle", io.BytesIO()
    before = {key: sys.modules.get(key) for key in ("joblib", name)}
    sys.modules.update({"joblib": types.ModuleType("joblib"), name: types.ModuleType(name)})
    sys.modules[name].NumpyArrayWrapper = NumpyArrayWrapper  # pyright: ignore[reportAttributeAccessIssue]
    try:
        _Pickler(stream, protocol).dump(content)
    finally:
        for key, module in before.items():
            sys.modules.pop(key) if module is None else sys.modules.update({key: module})
    return zlib.compress(stream.getvalue()) if compressed else stream.getvalue()

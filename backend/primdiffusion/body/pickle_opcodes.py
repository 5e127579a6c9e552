"""Interpret the opcodes of a pickle without Python's unpickler, which sizes its memory by numbers in the file.

Globals are looked up by the caller, who returns inert classes. Protocols 0 to 5 are read, with text of Python 2 as
latin1; extension registries, persistent references and buffers outside of the file are not.
"""

from __future__ import annotations

import codecs
import struct
from collections.abc import Callable
from typing import Any

MOST_OPERATIONS = 300_000
"""SMPL's files have a few thousand: their arrays are one string each."""
LONGEST_LINE = 1_000_000
_DIGITS = 20


class PickleError(ValueError):
    """The data are not a pickle, or exceed a limit. The message is a reason."""


class Inert:
    """Constructor arguments and state of a pickled object."""

    def __init__(self, *arguments: object) -> None:
        self.arguments = arguments
        self.state: object = None

    def set_state(self, state: object) -> None:
        """Store the state."""
        self.state = state


Find = Callable[[str, str], Callable[..., object]]
_MARK = object()
_SIZES = {b"U": "B", b"T": "<i", b"C": "B", b"B": "<I", b"\x8e": "<Q", b"\x96": "<Q", b"X": "<I", b"\x8c": "B",
          b"\x8d": "<Q", b"\x8a": "B", b"\x8b": "<i"}  # fmt: skip
"""Formats of the lengths of strings and long integers."""
_NUMBERS = {b"K": "B", b"M": "<H", b"J": "<i", b"G": ">d"}
_CONSTANTS: dict[bytes, Any] = {b"N": None, b"\x88": True, b"\x89": False}
_EMPTY: dict[bytes, Callable[[], Any]] = {b"]": list, b"}": dict, b")": tuple}
_FRAME, _PROTOCOL, _STOP = b"\x95", b"\x80", b"."


def load_pickle(data: bytes, find: Find) -> object:
    """Return the object that a pickle describes. `find` maps module and name to an inert class.

    Raises PickleError for anything that is not a whole pickle, and what `find` raises.
    """
    try:
        return _Machine(data, find).run()
    except (IndexError, KeyError, TypeError, AttributeError, struct.error, UnicodeError, OverflowError) as e:
        raise PickleError(f"an operation does not fit its values: {str(e)[:80]}") from e


class _Machine:
    def __init__(self, data: bytes, find: Find) -> None:
        self._data, self._find, self._at = data, find, 0
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self) -> object:
        for _ in range(MOST_OPERATIONS):
            code = self._take(1)
            if code == _STOP:
                return self._stack.pop()
            self._step(code)
        raise PickleError(f"it has more than {MOST_OPERATIONS} operations, more than a body model")

    def _step(self, code: bytes) -> None:
        stack = self._stack
        if code in _CONSTANTS:
            stack.append(_CONSTANTS[code])
        elif code in _EMPTY:
            stack.append(_EMPTY[code]())
        elif code in _NUMBERS:
            stack.append(self._number(_NUMBERS[code]))
        elif code in _SIZES:
            stack.append(_string(code, self._take(self._number(_SIZES[code]))))
        elif code == b"(":
            stack.append(_MARK)
        elif code == _PROTOCOL:
            if self._take(1)[0] > 5:
                raise PickleError("its protocol is newer than 5")
        elif code == _FRAME:
            self._take(8)
        elif (method := _METHODS.get(code)) is not None:
            method(self)
        else:
            raise PickleError(f"the operation {code!r} is not used by body models")

    def _take(self, count: int) -> bytes:
        end = self._at + count
        if count < 0 or end > len(self._data):
            raise PickleError("it is cut short")
        taken = self._data[self._at : end]
        self._at = end
        return taken

    def _line(self) -> bytes:
        end = self._data.find(b"\n", self._at, self._at + LONGEST_LINE)
        if end < 0:
            raise PickleError("it is cut short")
        line = self._take(end - self._at)
        self._at += 1
        return line

    def _number(self, kind: str) -> Any:
        return struct.unpack(kind, self._take(struct.calcsize(kind)))[0]

    def _marked(self) -> list[Any]:
        """Pop the values above the last mark, and the mark."""
        for place in range(len(self._stack) - 1, -1, -1):
            if self._stack[place] is _MARK:
                values = self._stack[place + 1 :]
                del self._stack[place:]
                return values
        raise PickleError("a mark is missing")

    def _pop(self, count: int) -> list[Any]:
        if len(self._stack) < count:
            raise PickleError("a value is missing")
        values = self._stack[len(self._stack) - count :]
        del self._stack[len(self._stack) - count :]
        return values

    # operations, by their names in `pickletools`

    def _int(self) -> None:
        line = self._line().strip()
        self._stack.append({b"00": False, b"01": True}[line] if line in (b"00", b"01") else _integer(line))

    def _long(self) -> None:
        self._stack.append(_integer(self._line().strip().removesuffix(b"L")))

    def _float(self) -> None:
        self._stack.append(float(self._line()[:100]))

    def _quoted(self) -> None:
        line = self._line().strip()
        if len(line) < 2 or line[:1] != line[-1:] or line[:1] not in (b"'", b'"'):
            raise PickleError("a string has no quotes")
        self._stack.append(codecs.escape_decode(line[1:-1])[0].decode("latin1"))  # type: ignore[attr-defined]

    def _unicode(self) -> None:
        self._stack.append(self._line().decode("raw-unicode-escape"))

    def _put(self, index: int) -> None:
        self._memo[index] = self._stack[-1]

    def _get(self, index: int) -> None:
        self._stack.append(self._memo[index])

    def _tuple(self, count: int) -> None:
        self._stack.append(tuple(self._pop(count)))

    def _append(self) -> None:
        value = self._stack.pop()
        _of(self._stack[-1], list).append(value)

    def _appends(self) -> None:
        values = self._marked()
        _of(self._stack[-1], list).extend(values)

    def _set_items(self, pairs: list[Any]) -> None:
        target = _of(self._stack[-1], dict)
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            if not isinstance(key, str | int | bytes):  # others may be nested, and hash without a limit
                raise PickleError("a key of a dictionary is no name")
            target[key] = value

    def _dictionary(self) -> None:
        pairs = self._marked()
        self._stack.append({})
        self._set_items(pairs)

    def _global(self) -> None:
        module = self._line().decode("utf-8")
        self._stack.append(self._find(module, self._line().decode("utf-8")))

    def _stack_global(self) -> None:
        module, name = self._pop(2)
        self._stack.append(self._find(_of(module, str), _of(name, str)))

    def _instance(self) -> None:
        arguments = self._marked()
        self._global()
        self._stack.append(_made(self._stack.pop(), tuple(arguments)))

    def _object(self) -> None:
        kind, *arguments = self._marked()
        self._stack.append(_made(kind, tuple(arguments)))

    def _reduce(self) -> None:
        kind, arguments = self._pop(2)
        self._stack.append(_made(kind, _of(arguments, tuple)))

    def _reduce_named(self) -> None:
        kind, arguments, _ = self._pop(3)
        self._stack.append(_made(kind, _of(arguments, tuple)))

    def _build(self) -> None:
        state = self._stack.pop()
        _of(self._stack[-1], Inert).set_state(state)


_METHODS: dict[bytes, Callable[[_Machine], object]] = {
    b"I": _Machine._int, b"L": _Machine._long, b"F": _Machine._float, b"S": _Machine._quoted, b"V": _Machine._unicode,
    b"p": lambda m: m._put(_integer(m._line())), b"q": lambda m: m._put(m._number("B")),
    b"r": lambda m: m._put(m._number("<I")), b"\x94": lambda m: m._put(len(m._memo)),
    b"g": lambda m: m._get(_integer(m._line())), b"h": lambda m: m._get(m._number("B")),
    b"j": lambda m: m._get(m._number("<I")),
    b"t": lambda m: m._stack.append(tuple(m._marked())), b"\x85": lambda m: m._tuple(1),
    b"\x86": lambda m: m._tuple(2), b"\x87": lambda m: m._tuple(3),
    b"l": lambda m: m._stack.append(m._marked()), b"a": _Machine._append, b"e": _Machine._appends,
    b"d": _Machine._dictionary,
    b"s": lambda m: m._set_items(m._pop(2)), b"u": lambda m: m._set_items(m._marked()),
    b"c": _Machine._global, b"\x93": _Machine._stack_global, b"i": _Machine._instance, b"o": _Machine._object,
    b"R": _Machine._reduce, b"\x81": _Machine._reduce, b"\x92": _Machine._reduce_named, b"b": _Machine._build,
    b"0": lambda m: m._stack.pop(), b"1": lambda m: m._marked(), b"2": lambda m: m._stack.append(m._stack[-1]),
}  # fmt: skip


def _string(code: bytes, data: bytes) -> Any:
    if code in (b"X", b"\x8c", b"\x8d"):
        return data.decode("utf-8", "surrogatepass")
    if code in (b"U", b"T"):
        return data.decode("latin1")
    if code in (b"\x8a", b"\x8b"):
        if len(data) > 16:
            raise PickleError("an integer is too long")
        return int.from_bytes(data, "little", signed=True)
    return data


def _integer(text: bytes) -> int:
    if len(text) > _DIGITS:
        raise PickleError("an integer is too long")
    return int(text)


def _of(value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise PickleError(f"a {type(value).__name__} stands where a {kind.__name__} belongs")
    return value


def _made(kind: Any, arguments: tuple[Any, ...]) -> object:
    """Construct an inert object: `find` returns nothing else that can be called."""
    if not isinstance(kind, type):
        raise PickleError("a value is called that is no class")
    return kind(*arguments)

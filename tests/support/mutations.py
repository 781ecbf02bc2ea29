"""Damage to files, as disks, editors, other programs and strangers do it."""

import numpy as np

_WORDS = (b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"1_0", b"0x10", b"1e-400", b"99999999999999999999", b"1e308",
          b"", b"null", b"true", b"[]", b"{}", b'"1"', b"1,5", b"-0.0", b"1e5", "٣".encode())


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """`data` with one to three random changes."""
    for _ in range(int(rng.integers(1, 4))):
        data = _CHANGES[int(rng.integers(len(_CHANGES)))](data, rng)
    return data


def _span(data, rng, most=40):
    start = int(rng.integers(0, len(data) + 1))
    return start, min(len(data), start + int(rng.integers(1, most)))


def _flip(data, rng):
    if not data:
        return b"\x00"
    place = int(rng.integers(len(data)))
    return data[:place] + bytes([data[place] ^ (1 << int(rng.integers(8)))]) + data[place + 1:]


def _byte(data, rng):
    start, _ = _span(data, rng)
    return data[:start] + bytes([int(rng.integers(256))]) + data[start + 1:]


def _delete(data, rng):
    start, stop = _span(data, rng)
    return data[:start] + data[stop:]


def _insert(data, rng):
    start, _ = _span(data, rng)
    return data[:start] + rng.bytes(int(rng.integers(1, 20))) + data[start:]


def _repeat(data, rng):
    start, stop = _span(data, rng, 400)
    return data[:stop] + data[start:stop] + data[stop:]


def _truncate(data, rng):
    return data[:int(rng.integers(0, len(data) + 1))]


def _numbers(data):
    import re

    return list(re.finditer(rb"[-+.\deE]+", data))


def _word(data, rng):
    found = _numbers(data)
    if not found:
        return _byte(data, rng)
    m = found[int(rng.integers(len(found)))]
    return data[:m.start()] + _WORDS[int(rng.integers(len(_WORDS)))] + data[m.end():]


def _digit(data, rng):
    found = [m for m in _numbers(data) if any(48 <= b < 58 for b in m.group())]
    if not found:
        return _byte(data, rng)
    m = found[int(rng.integers(len(found)))]
    digits = [i for i in range(m.start(), m.end()) if 48 <= data[i] < 58]
    place = digits[int(rng.integers(len(digits)))]
    return data[:place] + str(int(rng.integers(10))).encode() + data[place + 1:]


def _swap_lines(data, rng):
    lines = data.split(b"\n")
    i, j = rng.integers(len(lines), size=2)
    lines[i], lines[j] = lines[j], lines[i]
    return b"\n".join(lines)


def _swap_numbers(data, rng):
    found = _numbers(data)
    if len(found) < 2:
        return _byte(data, rng)
    a, b = sorted(rng.choice(len(found), 2, replace=False))
    a, b = found[a], found[b]
    return data[:a.start()] + b.group() + data[a.end():b.start()] + a.group() + data[b.end():]


_CHANGES = (_flip, _flip, _byte, _delete, _insert, _repeat, _truncate, _word, _word, _digit, _digit, _swap_lines,
            _swap_numbers)

"""What views are called, on disk and by those who look for one: the one rule for all who write, read or choose."""

import hashlib
import os
import re
import sys
import unicodedata
from collections import Counter
from collections.abc import Collection, Sequence
from difflib import get_close_matches
from pathlib import Path

from pagas_cl.errors import InputError, short

OWN = ".pagas_cl"      # folders of this name, inside folders of results, hold what a run keeps for itself
_LONGEST = 240         # bytes of a part of a path: file systems take 255, and suffixes follow
_KINDS = (".npz", ".json")
_REFUSED = re.compile(r'[<>:"|?*\0-\x1f]|[ .]$|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)', re.IGNORECASE)      # by Windows


def file_stems(names: Sequence[str]) -> list[str]:
    """What the files of each view are called, before their suffix: no two the same, on any file system.

    The stem of the name; where another view has the same, the name without suffix, its folders included; where that is
    not enough the whole name; where a file system may not take or distinguish it (capitals alone, parts that are too
    long), a flat one with a hash. InputError as check_names.
    """
    check_names(names)
    candidates = [_candidates(name) for name in names]
    while True:
        stems = [left[0] for left in candidates]
        uses = Counter(map(file_key, stems))
        clashing = [left for left in candidates if len(left) > 1 and uses[file_key(left[0])] > 1]
        if not clashing:
            return stems
        for left in clashing:
            del left[0]


def _candidates(name: str) -> list[str]:
    """What the files of a view may be called, the shortest first."""
    path, digest = Path(name), hashlib.blake2b(name.encode("utf-8", "surrogatepass"), digest_size=8).hexdigest()
    hashed = f"{_flat(name) or 'view'}~{digest}"
    if not _fits(path.stem):
        return [hashed]
    return [path.stem, *filter(_fits, (path.with_suffix("").as_posix(), path.as_posix())), hashed]


def check_names(names: Sequence[str], where: str = "") -> None:
    """InputError, which says `where`, for a name that is there twice, is empty, or leads out of a folder."""
    where = where and f"{where}: "
    for name in names:
        if Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name or not Path(name).name:
            raise InputError(f"{where}view {short(name)} cannot name files in the output folder, expected a relative "
                             "name without '..': call the photo so, or put it into the scene's folder")
    twice = [name for name, uses in Counter(names).items() if uses > 1]
    if twice:
        raise InputError(f"{where}{names.count(twice[0])} views are called {short(twice[0])}, expected a name for "
                         "each, by which its files and results are found")


def flat_stem(name: str, taken: Collection[str] = ()) -> str:
    """A view's name, without suffix, as part of a file's, not in `taken`: `cam1/a b.jpg` -> `cam1_a_b` (or ~2)."""
    path = Path(name)
    stem = _flat(str(path.parent / path.stem)) or "view"
    keys, number, found = {file_key(other) for other in taken}, 2, stem
    while file_key(found) in keys:
        found, number = f"{stem}~{number}", number + 1
    return found


def place_of(wanted: str, names: Sequence[str], where: str = "the scene") -> int:
    """Place of the view called `wanted`: its whole name, file name or stem. InputError: none is, or several are."""
    for key in (str, lambda name: Path(name).name, lambda name: Path(name).stem):
        found = [place for place, name in enumerate(names) if key(name) == wanted]
        if len(found) == 1:
            return found[0]
        if found:
            more = f" and {len(found) - 5} more" if len(found) > 5 else ""
            raise InputError(f"view {wanted!r} could be any of {', '.join(names[place] for place in found[:5])}{more}: "
                             "give the whole name")
    near = get_close_matches(wanted, [*names, *(Path(name).stem for name in names)], n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise InputError(f"there is no view {wanted!r} among the {len(names)} of {where}{hint}")


def file_key(stem: str) -> str:
    """Equal for what a file system may take for one name."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFD", stem).casefold())


def _fits(stem: str) -> bool:
    """Whether a path is neither too long, nor refused by the system, nor taken for a file or folder of another kind."""
    parts = Path(stem).parts
    if sys.platform == "win32" and any(map(_REFUSED.search, parts)):
        return False
    try:
        longest = max(len(os.fsencode(part)) for part in parts)
    except UnicodeEncodeError:
        return False
    return (longest <= _LONGEST and not any(file_key(part).startswith(OWN) for part in parts)
            and not any(file_key(folder).endswith(_KINDS) for folder in parts[:-1]))


def _flat(text: str) -> str:
    """Letters, digits and `_.-` alone, no part of a path hidden or too long."""
    plain = re.sub(r"[^\w.-]+", "_", text).strip("_.")
    return plain.encode()[:_LONGEST // 2].decode(errors="ignore")

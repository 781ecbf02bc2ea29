"""No word of docs/words.md's left column stands in names, comments, docstrings, messages or pages.

    python tests/test_words.py PATH ...      # lists where they stand
"""

import io
import re
import sys
import tokenize
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PLACES = ("pagas_cl", "filters", "cl_kernels", "docs", "README.md", "CONTRIBUTING.md")
SUFFIXES = {".py", ".cl", ".clh", ".md", ".css", ".js"}
NOT_READ = {"words.md"}


@cache
def banned() -> list[tuple[re.Pattern, str, bool]]:
    """(pattern, what to say, whether only in names) of each word."""
    rows = [line.strip("|").split("|") for line in (ROOT / "docs/words.md").read_text().splitlines()
            if line.startswith("|") and not line.startswith(("|---", "| not |"))]
    return [(re.compile(rf"(?<![A-Za-z]){re.escape(word.strip())}(?![A-Za-z])", re.IGNORECASE), say.strip(),
             where.strip() == "names") for words, say, where in rows for word in words.split(",")]


@cache
def any_of_them() -> re.Pattern:
    """Whatever has one of the words."""
    return re.compile("|".join(pattern.pattern for pattern, _, _ in banned()), re.IGNORECASE)


def texts(path: Path) -> list[tuple[int, str, bool]]:
    """(line, text, whether it is a name) of all that is read of a file; names as their parts, in small letters."""
    content = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return [(number, line.replace("_", " _"), False) for number, line in enumerate(content.splitlines(), 1)]
    found = []
    for token in tokenize.generate_tokens(io.StringIO(content).readline):
        if token.type == tokenize.NAME:
            found.append((token.start[0], " ".join(parts_of(token.string)), True))
        elif token.type in (tokenize.COMMENT, tokenize.STRING):
            found += [(token.start[0] + number, line, False) for number, line in enumerate(token.string.splitlines())]
    return found


def parts_of(name: str) -> list[str]:
    """snake_case and CamelCase names as words; the whole name comes first."""
    return [name, *re.findall(r"[A-Za-z][a-z]*|[A-Z]+(?![a-z])", name)]


def hits(path: Path) -> list[str]:
    """Where a file has words that are banned."""
    found = []
    for line, text, is_name in texts(path):
        if not any_of_them().search(text):
            continue
        for pattern, say, names_only in banned():
            if (is_name or not names_only) and pattern.search(text):
                found.append(f"{path}:{line}: {pattern.pattern[13:-12]!r}, say {say}: {text.strip()[:80]}")
    return found


def files(places) -> list[Path]:
    return sorted(path for place in map(Path, places) for path in ([place] if place.is_file() else place.rglob("*"))
                  if path.suffix in SUFFIXES and path.name not in NOT_READ and "__pycache__" not in path.parts)


@pytest.mark.parametrize("place", PLACES)
def test_no_banned_word(place):
    found = [hit for path in files([ROOT / place]) for hit in hits(path)]
    assert not found, "\n".join(found)


if __name__ == "__main__":
    print(*[hit for path in files(sys.argv[1:]) for hit in hits(path)], sep="\n")

"""XML from strangers: no entities, no external references, bounded size and depth."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

from pagas_cl.errors import InputError
from pagas_cl.scene.readers import untrusted

_DEPTH = 32
_BYTES = 64 << 20


def read_xml(path: Path, root: str) -> ElementTree.Element:
    """The root element of an XML file, which must be called `root`.

    InputError for anything that is not plain, well-formed XML: entity declarations (which can expand without bound, or
    read other files) are refused before anything is expanded.
    """
    data = untrusted.read_bytes(Path(path), _BYTES)
    try:
        _inspect(data, path)
        element = ElementTree.fromstring(data)
    except (expat.ExpatError, ElementTree.ParseError, ValueError, LookupError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is not valid XML ({error}): is the file damaged?") from error
    if element.tag != root:
        raise InputError(f"{path}: the root element is <{element.tag[:40]}>, expected <{root}>")
    return element


def _inspect(data: bytes, path: Path) -> None:
    """Walk through once with handlers that refuse what the second parse must not see."""
    depth = 0

    def refuse(*_: object) -> NoReturn:
        raise InputError(f"{path} declares XML entities, which are not read; remove them from its DOCTYPE")

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _DEPTH:
            raise InputError(f"{path} nests its elements more than {_DEPTH} deep: is the file damaged?")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.EntityDeclHandler = refuse
    parser.UnparsedEntityDeclHandler = refuse
    parser.ExternalEntityRefHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(data, True)

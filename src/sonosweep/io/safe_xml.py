"""XML from anyone: no document types, so no entities, and no file larger than expected."""

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from sonosweep.errors import FormatError
from sonosweep.io.header_lines import open_binary

BYTES_PER_MB = 1 << 20


def parse_xml(path: Path, what: str, largest_mb: int = 16) -> Element:
    """Return the root element of an XML file; names keep their prefix, if they have one.

    Args:
        path: The file.
        what: What it should be, such as ``"PLUS configuration"``.
        largest_mb: No such file is larger.

    Raises:
        FormatError: If it is missing, too large, no XML, or declares a document type.
    """
    with open_binary(path) as file:
        text = file.read(largest_mb * BYTES_PER_MB + 1)
    if len(text) > largest_mb * BYTES_PER_MB:
        raise FormatError(f"'{path}' is larger than any {what}: expected XML below {largest_mb} MB")

    def refuse(*_: Any) -> None:  # expat passes the declaration's parts
        raise FormatError(f"'{path}' declares a document type, which a {what} does not: remove it")

    builder = TreeBuilder()
    parser = expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(text, True)
        return builder.close()
    # expat raises ValueError for an encoding that Python does not know.
    except (expat.ExpatError, ValueError, LookupError, AssertionError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"'{path}' is no XML: {error}") from error

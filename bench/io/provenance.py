"""Provenance marks: exported files declare that a program generated their content.

The term is IPTC's digital source type (https://cv.iptc.org/newscodes/digitalsourcetype/), which image archives and social
networks read. In images it is XMP metadata; the pixels are not changed. Frames for metrics have no mark, since their
digests are recorded.
"""

from __future__ import annotations

import struct
import zlib
from importlib.metadata import version

RENDER = "trainedAlgorithmicMedia"
"""Made by a model trained on recordings: a render of an avatar."""
COMPOSITE = "compositeWithTrainedAlgorithmicMedia"
"""Renders with other images: sheets, pages, videos with the captured image."""
SYNTHETIC = "algorithmicMedia"
"""Made by a program without training data: a synthetic capture."""

_SCHEME = "http://cv.iptc.org/newscodes/digitalsourcetype/"
_XMP = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:xmp="http://ns.adobe.com/xap/1.0/" xmlns:Iptc4xmpExt="http://iptc.org/std/Iptc4xmpExt/2008-02-29/">
<xmp:CreatorTool>{tool}</xmp:CreatorTool>
<Iptc4xmpExt:DigitalSourceType>{source}</Iptc4xmpExt:DigitalSourceType>
</rdf:Description></rdf:RDF></x:xmpmeta>
<?xpacket end="r"?>"""
_HEADER = 33  # bytes of a PNG's signature and IHDR chunk, which are first


def tool() -> str:
    """The suite's name and version."""
    return f"headbench {version('headbench')}"


def source_type(kind: str) -> str:
    """IPTC's URI of one of the terms above."""
    return _SCHEME + kind


def note(kind: str) -> str:
    """Provenance as one line, for formats without suitable metadata."""
    return f"{tool()}; digital source type {source_type(kind)}"


def xmp(kind: str) -> str:
    """An XMP packet for a file, or for the files beside it."""
    return _XMP.format(tool=tool(), source=source_type(kind))


def mark_png(content: bytes, kind: str) -> bytes:
    """Insert an XMP packet (an iTXt chunk) after the header of a PNG file; all other bytes are unchanged."""
    chunk = b"iTXt" + b"XML:com.adobe.xmp" + bytes(5) + xmp(kind).encode()
    framed = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return content[:_HEADER] + framed + content[_HEADER:]

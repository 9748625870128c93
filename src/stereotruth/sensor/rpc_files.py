"""RPCs as they come: in the image, or in a file beside it, in the forms of :data:`FORMS`."""

from __future__ import annotations

import logging
import re
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from rasterio.errors import RasterioError

from ..core.errors import InputError
from ..core.products.rasters import open_raster
from ..core.tables import decimal_number
from .rpc import RPC, SCALARS, VECTORS

log = logging.getLogger("stereotruth")

MAX_BYTES = 1_000_000  # of an RPC file; they have some 8000
MAX_XML_BYTES = 5_000_000  # which has orbits and attitudes besides
RPB_NAMES = {name.replace("_off", "offset").replace("_", ""): name for name in SCALARS}
RPB_NAMES |= {name.removesuffix("f").replace("_", ""): name for name in VECTORS}
# Possessive (++): a run of letters or blanks is looked at once, however long it is.
_RPB_ENTRY = re.compile(r"\b(\w++)\s*+=\s*+(?:\(([^()]*+)\)|\"?([^;\n\"(]*+))")
_TEXT_LINE = re.compile(r"\s*+([A-Za-z_]\w*+)?\s*+([:=]?)(.*)", re.DOTALL)


def _number(text: str) -> float:
    """The number that a value begins with; its unit may follow, another number must not.

    NaN, which no RPC may have, of an empty value.
    """
    if not (words := text.split()):
        return float("nan")
    if any(word[0] in "+-.0123456789" for word in words[1:]):
        raise ValueError(f"{text[:40]!r} is more than one number")
    return decimal_number(words[0])


def _numbers(text: str) -> list[float]:
    return [decimal_number(word) for word in text.replace(",", " ").split()]


def _put(found: dict[str, Any], name: str, value: Any) -> None:
    if name in found and found[name] != value:
        raise ValueError(f"{name} is there twice, with different values")
    found[name] = value


def _parse_text(text: str) -> dict[str, Any]:
    """Fields of a ``_RPC.TXT``: ``LINE_OFF: 123.0 pixels``, ``LINE_NUM_COEFF_1: 1.0E-3``."""
    found: dict[str, Any] = {}
    for line in text.splitlines():
        key, sign, value = _TEXT_LINE.match(line).groups()
        name = (key or "").lower()
        if sign and name in VECTORS:
            _put(found, name, _numbers(value))
        elif sign and (name in SCALARS or re.fullmatch(r"\w+_coeff_[0-9]+", name)):
            _put(found, name, _number(value))
    for name in VECTORS:
        if name not in found:
            missing = [i for i in range(1, 21) if f"{name}_{i}" not in found]
            if missing:
                raise ValueError(f"{name}_{missing[0]} missing")
            found[name] = [found[f"{name}_{i}"] for i in range(1, 21)]
    return found


def _parse_rpb(text: str) -> dict[str, Any]:
    """Fields of an ``.RPB`` (DigitalGlobe, GF-7): ``lineOffset = 1;``, ``lineNumCoef = (…);``."""
    found: dict[str, Any] = {}
    for key, group, value in _RPB_ENTRY.findall(text):
        if key.lower() == "specid" and value.strip().upper() == "RPC00A":
            raise ValueError("SpecId is RPC00A, whose terms have another order than RPC00B's")
        name = RPB_NAMES.get(key.lower())
        if name in VECTORS:
            _put(found, name, _numbers(group))
        elif name:
            _put(found, name, _number(value))
    return found


def _parse_xml(text: str) -> dict[str, Any]:
    """Fields of an XML of Vantor (DigitalGlobe, Maxar) or DIMAP, whatever its namespaces.

    Pixels count from 0 at the centre of the first one in Vantor's files and in DIMAP 3 (Pléiades
    Neo), and from 1 in DIMAP 2 (Pléiades, SPOT 6 and 7). Of an XML without an RPC there are none.
    """
    root = ElementTree.fromstring(text)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    found: dict[str, Any] = {}
    if (vantor := root.find(".//RPB")) is not None:
        if (vantor.findtext("SPECID") or "").strip().upper() == "RPC00A":
            raise ValueError("SPECID is RPC00A, whose terms have another order than RPC00B's")
        for element in vantor.iter():
            name = RPB_NAMES.get(element.tag.lower())
            if name:
                read = _numbers if name in VECTORS else _number
                _put(found, name, read(element.text or ""))
    elif (dimap := root.find(".//Global_RFM")) is not None:
        parts = (dimap.find(name) for name in ("GroundtoImage_Values", "Inverse_Model"))
        inverse = next(part for part in (*parts, dimap) if part is not None)
        lines = [*inverse.iter(), *dimap.iterfind("RFM_Validity/*")]
        found = _parse_text("\n".join(f"{one.tag}: {one.text or ''}" for one in lines))
        if inverse.tag != "GroundtoImage_Values":
            found |= {name: found[name] - 1.0 for name in ("line_off", "samp_off")}
    return found


# What follows an image's stem in the name of its RPC file, in any case of the letters, and how that
# is read; the first that is there counts, in GDAL's order.
FORMS = {".rpb": _parse_rpb, "_rpc.txt": _parse_text}
_AIRBUS = re.compile(r"img_(.+)_r1c1")  # its RPC is rpc_X.xml; of other tiles it would be moved


def rpc_file(image: str | Path) -> Path:
    """The file that :func:`read_rpc` takes the RPC of an image from: beside it, or itself."""
    image = Path(image)
    names = {path.name.lower(): path for path in sorted(image.parent.iterdir(), reverse=True)}
    found = (names.get((image.stem + ending).lower()) for ending in FORMS)
    return next(filter(None, found), image)


def _of_xml(image: Path) -> dict[str, Any]:
    """Fields of the first XML beside an image that has an RPC of it; none of them may be there."""
    stem = image.stem.lower()
    tile = _AIRBUS.fullmatch(stem)
    names = {path.name.lower(): path for path in sorted(image.parent.iterdir(), reverse=True)}
    for name in (f"{stem}.xml", f"rpc_{tile[1]}.xml" if tile else ""):
        if name in names and names[name].stat().st_size <= MAX_XML_BYTES:
            with suppress(ElementTree.ParseError):
                if found := _parse_xml(names[name].read_text(encoding="utf-8-sig")):
                    return found
    return {}


def _fields_of(image: Path, source: Path) -> dict[str, Any]:
    """The fields of an RPC file, or of the metadata of an image that is its own source."""
    if source == image:
        with open_raster(image) as dataset:
            tags = dataset.tags(ns="RPC")
        text = "\n".join(f"{key}: {value}" for key, value in tags.items())
        if not (found := _parse_text(text) if tags else _of_xml(image)):
            raise InputError(
                "image has no RPC metadata",
                file=image,
                remedy=f"put {image.stem}_RPC.TXT or {image.stem}.rpb beside it, or an RPC "
                "tag into the TIFF",
            )
        return found
    if (size := source.stat().st_size) > MAX_BYTES:
        raise ValueError(f"{size} bytes are more than any RPC has")
    parse = next(FORMS[ending] for ending in FORMS if source.name.lower().endswith(ending))
    return parse(source.read_text(encoding="utf-8-sig", errors="replace"))


def read_rpc(image: str | Path) -> RPC:
    """The RPC of an image file: from a file of :data:`FORMS` beside it, or its metadata.

    Metadata are those that GDAL reads, above all the TIFF tag RPCCoefficientTag (50844), else an
    XML of Vantor or Airbus that GDAL does not find. A file beside the image goes before the tag, as
    in GDAL, so that a better RPC can be put there.

    Raises InputError, naming the file, if there is none or it cannot be used.
    """
    image = Path(image)
    if not image.is_file():
        raise InputError("no such image", file=image, remedy="correct the path in the scene sheet")
    source = rpc_file(image)
    try:
        rpc = RPC.from_dict(_fields_of(image, source))
    except InputError:
        raise
    except RasterioError as error:
        raise InputError(
            f"not a raster that GDAL can read ({error})", file=image, remedy="check the file"
        ) from error
    except (ValueError, OSError, IndexError) as error:
        raise InputError(
            f"malformed RPC ({error})",
            file=source,
            remedy="get the RPC again from the image's supplier; 10 offsets and scales and four "
            "times 20 coefficients in RPC00B order are needed",
        ) from error
    log.info("RPC of %s from %s", image.name, "its metadata" if source == image else source.name)
    return rpc


def rpc_text(rpc: RPC) -> str:
    """``_RPC.TXT`` with all digits and, as GDAL and rpcm want it, without units."""
    values = rpc.to_dict()
    lines = [f"{name.upper()}: {values[name]!r}" for name in SCALARS]
    for name in VECTORS:
        lines += [f"{name.upper()}_{k}: {value!r}" for k, value in enumerate(values[name], 1)]
    return "\n".join(lines) + "\n"

"""RPCs as they come: in the image, or in a file beside it, in the forms of :data:`FORMS`."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

from rasterio.errors import RasterioError

from ..core.errors import InputError
from ..core.products.rasters import open_raster
from ..core.tables import decimal_number
from .rpc import RPC, SCALARS, VECTORS

log = logging.getLogger("stereotruth")

MAX_BYTES = 1_000_000  # of an RPC file; they have some 8000
UNITS = {"line": "pixels", "samp": "pixels", "lat": "degrees", "long": "degrees"}
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


# What follows an image's stem in the name of its RPC file, in any case of the letters, and how that
# is read; the first that is there counts, in GDAL's order.
FORMS = {".rpb": _parse_rpb, "_rpc.txt": _parse_text}


def rpc_file(image: str | Path) -> Path:
    """The file that :func:`read_rpc` takes the RPC of an image from: beside it, or itself."""
    image = Path(image)
    names = {path.name.lower(): path for path in sorted(image.parent.iterdir(), reverse=True)}
    found = (names.get((image.stem + ending).lower()) for ending in FORMS)
    return next(filter(None, found), image)


def _fields_of(image: Path, source: Path) -> dict[str, Any]:
    """The fields of an RPC file, or of the metadata of an image that is its own source."""
    if source == image:
        with open_raster(image) as dataset:
            tags = dataset.tags(ns="RPC")
        if not tags:
            raise InputError(
                "image has no RPC metadata",
                file=image,
                remedy=f"put {image.stem}_RPC.TXT or {image.stem}.rpb beside it, or an RPC "
                "tag into the TIFF",
            )
        return _parse_text("\n".join(f"{key}: {value}" for key, value in tags.items()))
    if (size := source.stat().st_size) > MAX_BYTES:
        raise ValueError(f"{size} bytes are more than any RPC has")
    parse = next(FORMS[ending] for ending in FORMS if source.name.lower().endswith(ending))
    return parse(source.read_text(encoding="utf-8-sig", errors="replace"))


def read_rpc(image: str | Path) -> RPC:
    """The RPC of an image file: from a file of :data:`FORMS` beside it, or its metadata.

    Metadata are those that GDAL reads, above all the TIFF tag RPCCoefficientTag (50844). A file
    beside the image goes before the tag, as in GDAL, so that a better RPC can be put there.

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
    log.info("RPC of %s from %s", image.name, "its tags" if source == image else source.name)
    return rpc


def rpc_text(rpc: RPC) -> str:
    """``_RPC.TXT`` with all digits."""
    values = rpc.to_dict()
    lines = [
        f"{name.upper()}: {values[name]!r} {UNITS.get(name.split('_')[0], 'meters')}"
        for name in SCALARS
    ]
    for name in VECTORS:
        lines += [f"{name.upper()}_{k}: {value!r}" for k, value in enumerate(values[name], 1)]
    return "\n".join(lines) + "\n"

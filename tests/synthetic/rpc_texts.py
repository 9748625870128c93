"""RPC files as text, from the fields that `rasterio.rpc.RPC.to_dict` gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

UNITS = {"line": "pixels", "samp": "pixels", "lat": "degrees", "long": "degrees"}


def rpc_text(values: Mapping[str, Any], units: bool = False) -> str:
    """``_RPC.TXT``, with or without units."""
    lines = []
    for name, value in values.items():
        if isinstance(value, list):
            lines += [f"{name.upper()}_{i}: {v:+.15E}" for i, v in enumerate(value, start=1)]
        else:
            unit = f" {UNITS.get(name.split('_')[0], 'meters')}" if units else ""
            lines.append(f"{name.upper()}: {value:+017.10f}{unit}")
    return "\r\n".join(lines) + "\r\n"


def rpb_text(values: Mapping[str, Any], spec: str = "RPC00B", more: Sequence[str] = ()) -> str:
    """``.RPB``; ``more`` lines at the beginning of its group."""
    lines = ['satId = "GF7";', 'bandId = "PAN";', f'SpecId = "{spec}";', "BEGIN_GROUP = IMAGE"]
    lines += more
    for ours, theirs in (("line", "line"), ("samp", "samp"), ("lat", "lat"), ("long", "long")):
        lines.append(f"\t{theirs}Offset = {values[f'{ours}_off']!r};")
        lines.append(f"\t{theirs}Scale = {values[f'{ours}_scale']!r};")
    lines.append(f"\theightOffset = {values['height_off']!r};")
    lines.append(f"\theightScale = {values['height_scale']!r};")
    for name in ("line_num", "line_den", "samp_num", "samp_den"):
        kind, part = name.split("_")
        body = ",\n".join(f"\t\t\t{v:+.15E}" for v in values[f"{name}_coeff"])
        lines.append(f"\t{kind}{part.capitalize()}Coef = (\n{body});")
    return "\n".join([*lines, "END_GROUP = IMAGE", "END;", ""])


def dimap_text(values: Mapping[str, Any], version: int = 2) -> str:
    """``RPC_….XML`` of DIMAP 2 (Pléiades, SPOT), whose pixels count from 1, or 3 (Pléiades Neo)."""
    names = [name for name in values if not name.startswith("err")]
    inverse = "".join(
        f"<{name.upper()}_{i}>{v!r}</{name.upper()}_{i}>"
        for name in names
        if isinstance(values[name], list)
        for i, v in enumerate(values[name], start=1)
    )
    first = {"samp_off": 1, "line_off": 1} if version == 2 else {}
    model = "Inverse_Model" if version == 2 else "GroundtoImage_Values"
    validity = "".join(
        f"<{name.upper()}>{values[name] + first.get(name, 0)!r}</{name.upper()}>"
        for name in names
        if not isinstance(values[name], list)
    )
    return (
        "<Dimap_Document><Rational_Function_Model><Global_RFM>"
        f"<{model}>{inverse}</{model}><RFM_Validity>{validity}</RFM_Validity>"
        "</Global_RFM></Rational_Function_Model></Dimap_Document>"
    )


def vantor_text(values: Mapping[str, Any], namespace: str = "") -> str:
    """``.XML`` of Vantor with an IMD and an RPB, in a namespace as since 2026, or in none."""
    fields = ""
    for name, value in values.items():
        tag = name.upper().replace("_OFF", "OFFSET").replace("COEFF", "COEF").replace("_", "")
        if isinstance(value, list):
            fields += f"<{tag}List><{tag}>{' '.join(map(repr, value))}</{tag}></{tag}List>"
        elif value is not None:
            fields += f"<{tag}>{value!r}</{tag}>"
    image = (
        "<FIRSTLINETIME>2020-10-25T03:12:45.000000Z</FIRSTLINETIME>"
        "<MEANSUNAZ>161.5</MEANSUNAZ><MEANSUNEL>44.9</MEANSUNEL>"
    )
    root = f'<isd xmlns="{namespace}">' if namespace else "<isd>"
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n{root}<IMD><IMAGE>{image}</IMAGE></IMD>'
        "<EPH><STARTTIME>2020-10-25T03:10:00.000000Z</STARTTIME></EPH>"
        f"<RPB><SPECID>RPC00B</SPECID><IMAGE>{fields}</IMAGE></RPB></isd>"
    )

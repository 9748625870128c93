"""The notebook of the documentation, executed; and the Python of a page.

``python -m tests.synthetic.notebook FOLDER`` executes docs/pair.ipynb in a folder in which
``stereotruth init --example demo`` has been called, and writes it with its outputs.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import re
import sys
from pathlib import Path
from typing import Any

from .project import ROOT

NOTEBOOK = ROOT / "docs/pair.ipynb"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def run_code(blocks: list[str], folder: Path) -> list[list[dict[str, Any]]]:
    """Outputs of pieces of Python, one after the other in one namespace, as a notebook has them."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names: dict[str, Any] = {"__name__": "__main__"}
    found = []
    with contextlib.chdir(folder):
        for block in blocks:
            said, outputs = io.StringIO(), []
            with contextlib.redirect_stdout(said):
                exec(compile(block, "<cell>", "exec"), names)
            if said.getvalue():
                text = said.getvalue().splitlines(keepends=True)
                outputs.append({"output_type": "stream", "name": "stdout", "text": text})
            for number in pyplot.get_fignums():
                picture = io.BytesIO()
                pyplot.figure(number).savefig(picture, dpi=60, bbox_inches="tight")
                data = {"image/png": base64.b64encode(picture.getvalue()).decode()}
                outputs.append({"output_type": "display_data", "data": data, "metadata": {}})
            pyplot.close("all")
            found.append(outputs)
    return found


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


if __name__ == "__main__":
    os.environ.setdefault("COLUMNS", "100")
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    cells = code_cells(notebook)
    for cell, outputs in zip(
        cells, run_code(["".join(c["source"]) for c in cells], Path(sys.argv[1]))
    ):
        cell["outputs"] = outputs
    NOTEBOOK.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")

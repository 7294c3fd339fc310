"""Write examples/tutorial.ipynb, the notebook of docs/tutorial.md without outputs: part of `make docs`."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[2]
PAGE, NOTEBOOK = ROOT / "docs" / "tutorial.md", ROOT / "examples" / "tutorial.ipynb"
BLOCK: Final = re.compile(r"^```python exec\n(.*?)\n```$", re.MULTILINE | re.DOTALL)
PAGES: Final = re.compile(r"\]\((?=[\w-]+\.md)")
"""A link to another page of docs/."""


def notebook(page: str) -> str:
    """A page as a notebook: its blocks in cells of code, the text between them in cells of text."""
    cells: list[dict[str, Any]] = []
    for i, text in enumerate(BLOCK.split(page)):  # text, code, text, ..., text
        code: dict[str, Any] = {"cell_type": "code", "execution_count": None, "outputs": []}
        cell = code if i % 2 else {"cell_type": "markdown"}
        source = text if i % 2 else PAGES.sub("](../docs/", text).strip()
        if source:
            cells.append({**cell, "id": f"cell-{i}", "metadata": {}, "source": source.splitlines(keepends=True)})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    content = {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(content, indent=1, ensure_ascii=False, sort_keys=True) + "\n"


if __name__ == "__main__":
    NOTEBOOK.write_text(notebook(PAGE.read_text(encoding="utf-8")), encoding="utf-8")

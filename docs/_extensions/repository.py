"""
MkDocs hook: what stands elsewhere in the repository is shown without a copy.

Pages of the changelog and of how to contribute, the figures of the benchmark, and README's tables in place of
``<!-- which algorithm -->`` and ``<!-- results -->``.
"""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[2]
PAGES = {"changelog.md": ROOT / "CHANGELOG.md", "contributing.md": ROOT / "CONTRIBUTING.md"}
TABLES = {
    "<!-- which algorithm -->": r"## Which algorithm\?\n\n(.*?)\n\n",
    "<!-- results -->": r"<!-- tables: start -->\n(.*?)\n<!-- tables: end -->",
}


def on_files(files: Any, config: Any) -> Any:
    for page, path in PAGES.items():
        files.append(File.generated(config, page, content=path.read_text(encoding="utf-8")))
    for path in sorted((ROOT / "benchmarks" / "figures").glob("*.png")):
        files.append(File.generated(config, f"images/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for marker, pattern in TABLES.items():
        if marker in markdown:
            table = re.search(pattern, readme, re.DOTALL)
            assert table is not None, f"README.md has no table for {marker}"
            markdown = markdown.replace(marker, table[1])
    return markdown

"""
MkDocs hook: the pages of the algorithms are those of the registry.

``Algorithms: registry`` in the navigation becomes a page per algorithm, ``<!-- algorithms -->`` links to them. One without a
page of its own in ``docs/modules`` gets the docstring of its class. ``::: sb3_chdp.CHDP`` is looked up where the class is
written.
"""

from typing import Any

from mkdocs.structure.files import File

from sb3_chdp.registry import ALGORITHMS

PAGES = {algorithm.display_name: f"modules/{algorithm.name}.md" for algorithm in ALGORITHMS.values()}


def on_config(config: Any) -> Any:
    config.nav = [
        {"Algorithms": [{name: page} for name, page in PAGES.items()]} if _is_marker(item) else item for item in config.nav
    ]
    return config


def _is_marker(item: Any) -> bool:
    return bool(item == {"Algorithms": "registry"})


def on_files(files: Any, config: Any) -> Any:
    for algorithm in ALGORITHMS.values():
        page = PAGES[algorithm.display_name]
        if files.get_file_from_path(page) is None:
            text = f"# {algorithm.display_name}\n\n::: {algorithm.class_path}\n"
            files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    links = ", ".join(f"[{name}]({page})" for name, page in PAGES.items())
    markdown = markdown.replace("<!-- algorithms -->", links)
    for algorithm in ALGORITHMS.values():
        markdown = markdown.replace(f"::: sb3_chdp.{algorithm.class_name}\n", f"::: {algorithm.class_path}\n")
    return markdown

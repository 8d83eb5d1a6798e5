"""
Griffe extension that makes Markdown of docstrings: Sphinx roles (``:class:`X```) become links, or code where the docs have
no page on X, and indented lists become lists.
"""

import re
import textwrap
from typing import Any

import griffe

ROLE = re.compile(r":(?:py:)?(?:class|func|meth|mod|attr|data|exc|obj):`~?(?P<target>[^`<>]+)`")


# A list that follows a line with a colon, indented as in reStructuredText
INDENTED_LIST = re.compile(r":\n(?P<items> {4}1\. .*(?:\n {4}.*)*)")


def _identifier(target: str, scope: griffe.Object) -> str:
    """:return: full path of what is called ``target`` in the scope, ``target`` itself if nothing is"""
    first, _, rest = target.partition(".")
    while True:
        try:
            path = scope.members[first].path if first in scope.members else scope.resolve(first)
            break
        except griffe.NameResolutionError:
            if scope.parent is None:
                return target
            scope = scope.parent
    path = f"{path}.{rest}" if rest else path
    try:
        # Past the imports, to where it is defined
        return scope.modules_collection[path].canonical_path
    except (KeyError, griffe.AliasResolutionError):
        return path


def replace_roles(text: str, scope: griffe.Object) -> str:
    """
    :param text: a docstring
    :param scope: the object that it describes
    :return: the docstring with an optional cross-reference of mkdocs-autorefs for every role
    """

    def link(match: re.Match[str]) -> str:
        target = match["target"].removesuffix("()")
        identifier = _identifier(target, scope)
        shown = target.rpartition(".")[2] if target.startswith(("sb3_chdp.", "stable_baselines3.")) else target
        return f'<autoref optional identifier="{identifier}"><code>{shown}</code></autoref>'

    return ROLE.sub(link, text)


def set_off_lists(text: str) -> str:
    """:return: the docstring with lists as Markdown wants them: after an empty line, not indented"""
    return INDENTED_LIST.sub(lambda match: ":\n\n" + textwrap.dedent(match["items"]), text)


class Docstrings(griffe.Extension):
    """Works on every docstring of a package once all of it is loaded."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        self._visit(pkg)

    def _visit(self, scope: griffe.Object) -> None:
        if scope.docstring is not None:
            scope.docstring.value = set_off_lists(replace_roles(scope.docstring.value, scope))
        for member in scope.members.values():
            if not member.is_alias:
                self._visit(member)

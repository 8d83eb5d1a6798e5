"""``OneOf`` action spaces, whose parts may have discrete values of their own."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_chdp.common.space_tree import discrete_leaves, get_part, replace_part


class OneOfChoices:
    """
    The discrete actions of a ``OneOf``: a part without discrete values is one, another has one for each combination of them.

    ``OneOf((Discrete(2), Box, Tuple(Discrete(3), Box)))`` has 2 + 1 + 3, those of its first part have no parameters.

    :param parts: its parts
    :param n_most: largest number of discrete actions
    :raises ValueError: if there are more, or a part holds something that is neither discrete nor a box
    """

    def __init__(self, parts: Sequence[spaces.Space[Any]], n_most: int):
        self._leaves = [list(discrete_leaves(part, f"action_space.spaces[{i}]")) for i, part in enumerate(parts)]
        radices = [[radix for leaf in leaves for radix in leaf.radices] for leaves in self._leaves]
        n = sum(map(math.prod, radices))
        if n > n_most:
            raise ValueError(f"The parts of a OneOf have {n} discrete actions, more than the {n_most} supported")
        #: part and digits of every discrete action
        self._choices = [(i, digits) for i, sizes in enumerate(radices) for digits in np.ndindex(*sizes)]
        self._indices = {choice: k for k, choice in enumerate(self._choices)}
        #: number of the part that a discrete action belongs to
        self.parts = [i for i, _ in self._choices]

    def native(self, k: int, part: Any) -> tuple[np.int64, Any]:
        """
        :param k: a discrete action
        :param part: its part with the parameters
        :return: the native action
        """
        i, digits = self._choices[k]
        for leaf in self._leaves[i]:
            own, digits = digits[: len(leaf.radices)], digits[len(leaf.radices) :]
            part = replace_part(part, leaf.path, leaf.value_of(np.array(own)))
        return np.int64(i), part

    def index_of(self, action: tuple[Any, Any]) -> int:
        """:return: the discrete action of a native action, -1 if there is no such one"""
        i, part = int(action[0]), action[1]
        if not 0 <= i < len(self._leaves):
            return -1
        digits = (digit for leaf in self._leaves[i] for digit in leaf.digits_of(get_part(part, leaf.path)).tolist())
        return self._indices.get((i, tuple(digits)), -1)

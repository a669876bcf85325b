"""A map's state as facts and arrays, and back."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from aquaflow.base.errors import DamagedError
from aquaflow.mapping.state import deserialise_views, serialise
from aquaflow.render.views import View
from tests.mapping.mapping_scenes import grown, settings


def test_what_only_some_views_have_is_theirs_again_in_few_arrays() -> None:
    mapper = grown(settings(), count=5)
    for i, view in enumerate(mapper.views):
        view.light = torch.full((3, 1 + i, 2), float(i)) if i in (1, 3) else None
        view.explained = torch.arange(12).reshape(4, 3) % (i + 1) == 0 if i else None
    facts, arrays = serialise(mapper)
    again = deserialise_views(facts, arrays)
    assert len([name for name in arrays if name.startswith("views.")]) == 4 + 2 * 3
    for view, same in zip(mapper.views, again, strict=True):
        assert_same(view.light, same.light)
        assert_same(view.explained, same.explained)


def test_views_of_an_earlier_file_keep_their_light() -> None:
    mapper = grown(settings(), count=3)
    for view in mapper.views:
        view.light = None
    light = np.arange(6, dtype=np.float32).reshape(3, 1, 2)
    facts, arrays = serialise(mapper)
    views: list[View] = deserialise_views(facts, {**arrays, "views.light2": light})
    assert [view.light is not None for view in views] == [False, False, True]
    assert_same(views[2].light, torch.from_numpy(light))


def test_light_of_another_length_is_damage() -> None:
    mapper = grown(settings(), count=2)
    mapper.views[0].light = torch.zeros(3, 2, 2)
    facts, arrays = serialise(mapper)
    with pytest.raises(DamagedError, match="light"):
        deserialise_views(facts, {**arrays, "views.light.values": np.zeros(11, np.float32)})


def assert_same(a: torch.Tensor | None, b: torch.Tensor | None) -> None:
    assert (a is None) == (b is None)
    assert a is None or (b is not None and a.dtype == b.dtype and torch.equal(a, b))

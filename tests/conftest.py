"""Order of the tests: those marked slow run last, so that a mistake shows within seconds."""

import pytest
from hypothesis import settings

# A busy machine is no failure: no example has a time limit.
settings.register_profile("neurolens", settings.get_profile("default"), deadline=None)
settings.load_profile("neurolens")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)

"""Order of the tests: those marked slow run last, so that a mistake shows within seconds."""

import pytest
from hypothesis import settings

# A busy machine is no failure: no example has a time limit.
settings.register_profile("neurolens", settings.get_profile("default"), deadline=None)
settings.load_profile("neurolens")


def pytest_configure(config: pytest.Config) -> None:
    # Many shipped tables state too little; what is warned of has tests of its own.
    config.addinivalue_line("filterwarnings", "ignore::neurolens.base.errors.NeurolensWarning")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def bodies() -> ModuleType:
    """The module solid.py of tests/elasticity: small bodies and their equilibria."""
    path = Path(__file__).parents[1] / "elasticity" / "solid.py"
    spec = importlib.util.spec_from_file_location("tests_solid", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module

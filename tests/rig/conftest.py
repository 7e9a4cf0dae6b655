import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from fab4d.io.cards import load_material
from fab4d.materials.cards import MaterialCard

# The shapes of the samples, which are no package.
sys.path.insert(0, str(Path(__file__).parents[2] / "samples"))


@pytest.fixture(scope="session")
def bar() -> ModuleType:
    """The module bent_bar.py beside this file."""
    spec = importlib.util.spec_from_file_location("rig_bent_bar", Path(__file__).with_name("bent_bar.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def card() -> MaterialCard:
    return load_material("paper-corrected", Path())

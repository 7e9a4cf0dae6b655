import pytest

from fab4d.io.data import data_folder


@pytest.mark.parametrize(("name", "content"), [("pipeline", "stages.toml"), ("profiles", "materials")])
def test_data_folders_are_found(name: str, content: str) -> None:
    assert (data_folder(name) / content).exists()


def test_unknown_data_folder_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="no-such-folder"):
        data_folder("no-such-folder")

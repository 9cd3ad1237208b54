import killing
import pytest

from headway.experiment import training


@pytest.fixture(scope="session")
def reference(tmp_path_factory):
    """A tiny run that was never killed."""
    path = tmp_path_factory.mktemp("reference") / "run"
    training.train_run(killing.tiny_config(), path)
    return path

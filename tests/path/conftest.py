import pytest


@pytest.fixture(autouse=True)
def no_bus_of_the_user(monkeypatch, tmp_path):
    """Neither the environment nor the files of whoever runs the tests name a bus here."""
    import os

    for name in list(os.environ):
        if name.startswith("CAN_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)

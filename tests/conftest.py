"""What tests of several packages share."""

import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

settings.register_profile("any machine", deadline=None)  # busy ones stand still for longer than an example takes
settings.load_profile("any machine")

# Modules are compiled once and kept, whatever the environment wants: tests start some hundred processes.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

sys.path.append(str(Path(__file__).parents[1] / "examples"))  # drives that are made: yard, hall

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # started in the background by a shell: interrupts are tested
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)  # before the hook of pytest-xdist that reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give tests that share towns, or a fixture of their module, to one worker of pytest-xdist, which makes it once."""
    for item in items:
        fixtures = getattr(item, "_fixtureinfo", None)
        defined = (
            [one for name in item.fixturenames for one in fixtures.name2fixturedefs.get(name, ())] if fixtures else []
        )
        if "kept_towns" in item.fixturenames:
            item.add_marker(pytest.mark.xdist_group("towns"))
        elif any(one.scope == "module" for one in defined):
            item.add_marker(pytest.mark.xdist_group(item.nodeid.split("::")[0]))


@pytest.fixture
def real() -> Callable[[str], Path]:
    """Give the path of a real recording beside the project, or skip the test."""
    default = Path(__file__).parents[1].parent / "shared" / "data" / "real"
    folder = Path(os.environ.get("OGM_DATA", default))

    def find(name: str) -> Path:
        if not folder.is_dir():
            pytest.skip(f"no real recordings at {folder} (set OGM_DATA to the folder that has them)")
        (path,) = folder.glob(name)
        return path

    return find


@pytest.fixture(scope="session")
def kept_towns() -> Iterator[Callable[..., Any]]:
    """Let the simulator keep the last towns, not the last one alone: building one takes seconds; give `build_town`."""
    from ogm.simulation import moments

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(moments, "_town", lru_cache(maxsize=8)(moments.build_town))
        yield moments._town


@pytest.fixture(scope="session")
def s3() -> Iterator[dict[str, str]]:
    """Start an S3 server; give the options of a client. Its bucket is ``maps``."""
    with warnings.catch_warnings(action="ignore"):  # of the server's packages
        import boto3
        from moto.server import ThreadedMotoServer

        server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        server.start()
        endpoint = "http://{}:{}".format(*server.get_host_and_port())
        keys = {"aws_access_key_id": "test", "aws_secret_access_key": "test", "region_name": "us-east-1"}
        boto3.client("s3", endpoint_url=endpoint, **keys).create_bucket(Bucket="maps")
    yield {"endpoint": endpoint, "access_key_id": "test", "secret_access_key": "test", "region": "us-east-1"}
    server.stop()

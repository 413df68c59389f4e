"""An S3 server on this machine, in a process of its own (moto)."""

import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager

KEYS = {"access_key_id": "test", "secret_access_key": "test", "region": "us-east-1"}


@contextmanager
def s3_server(bucket: str) -> Iterator[dict[str, str]]:
    """Start a server with an empty bucket; yield its address and keys as `ogm.storage.remote` takes them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    endpoint = f"http://127.0.0.1:{port}"
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
        try:
            for _ in range(600):  # a minute
                try:
                    urllib.request.urlopen(urllib.request.Request(f"{endpoint}/{bucket}", method="PUT"))
                    break
                except OSError:
                    time.sleep(0.1)
            yield KEYS | {"endpoint": endpoint}
        finally:
            server.kill()

"""However many devices or processes share out the pixels, the fit is the same."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).with_name("devices_fit.py")


def start(out, devices, *arguments):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    return subprocess.Popen(
        [sys.executable, SCRIPT, out, *map(str, arguments)],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(process, out):
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 0, said
    return json.loads(out.read_text())


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    out = tmp_path_factory.mktemp("one") / "fit.json"
    return finish(start(out, 1), out)


def assert_the_same(found, alone):
    np.testing.assert_allclose(found["image"], alone["image"], rtol=1e-5)
    (values, errors), (others, their_errors) = np.transpose(alone["estimates"]), np.transpose(found["estimates"])
    # A pedestal may be near 0.
    np.testing.assert_allclose(others, values, rtol=1e-5, atol=1e-3 * errors.min())
    np.testing.assert_allclose(their_errors, errors, rtol=1e-3)
    size = np.sqrt(np.diag(alone["gram"]))
    np.testing.assert_allclose(found["gram"] / np.outer(size, size), alone["gram"] / np.outer(size, size), atol=1e-5)


def test_eight_devices(tmp_path, alone):
    found = finish(start(tmp_path / "fit.json", 8), tmp_path / "fit.json")
    assert alone["devices"] == [1, 1]
    assert found["devices"] == [8, 1]
    assert_the_same(found, alone)


def test_two_processes_of_two_devices(tmp_path, alone):
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        address = f"localhost:{probe.getsockname()[1]}"
    outs = [tmp_path / f"{number}.json" for number in range(2)]
    running = [start(out, 2, address, 2, number) for number, out in enumerate(outs)]
    for process, out in zip(running, outs, strict=True):
        found = finish(process, out)
        assert found["devices"] == [4, 2]
        assert_the_same(found, alone)

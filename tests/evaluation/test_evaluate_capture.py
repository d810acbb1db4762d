"""A capture with registers: "before" is the output of the device, not the raw reading."""

from __future__ import annotations

import json

import numpy as np
import pytest
from streams import binary_device

from ahrsd.calibration import Affine
from ahrsd.inputs import Received, RegistersKnown, Stop
from ahrsd.recording.capture import CaptureWriter

C23 = np.array([[1.10, 0.05, -0.02], [0.03, 0.93, 0.04], [-0.01, 0.02, 1.02]])
B23 = (0.05, -0.12, 0.08)


@pytest.fixture
def captured(tmp_path):
    """Half a minute of a device with a wrong register 23, its true calibration in c.json."""
    identity = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    registers = {23: (*C23.ravel().tolist(), *B23), 26: identity, 84: (*identity, 0.0, 0.0, 0.0)}
    device = binary_device(8, registers)
    path = tmp_path / "run.mcap"
    with CaptureWriter(path, {}) as writer:
        writer.write(RegistersKnown(0, registers, "read before"))
        for step in range(600):
            writer.write(Received((step + 1) * 50_000_000, device.advance((step + 1) / 20)))
        writer.write(Stop(601 * 50_000_000, "end"))
    A, b = device.truth.soft_iron, device.truth.hard_iron_gauss
    body = {
        "schema": "ahrsd.calibration/1", "method": "truth", "recording": "none",
        "converged": True, "correction_matrix": np.linalg.inv(A).tolist(),
        "hard_iron_gauss": b.tolist(),
    }  # fmt: skip
    (tmp_path / "c.json").write_text(json.dumps(body))
    return path, device


def test_before_applies_the_registers_of_the_device(captured, run, capsys):
    path, device = captured
    assert run("evaluate", path, "--calibration", path.with_name("c.json"), "--json", "-") == 0
    field = json.loads(capsys.readouterr().out)["field"]
    assert field["after"]["spread"] < 0.005
    true_gauss = field["after"]["mean_gauss"]
    # mean size of C (A h + b - B) over all attitudes of h, compared with the command's result
    directions = np.random.default_rng(1).normal(size=(20_000, 3))
    h = true_gauss * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    reading = h @ device.truth.soft_iron.T + device.truth.hard_iron_gauss
    made = np.linalg.norm(Affine(C23, np.array(B23)).apply(reading), axis=1)
    assert field["before"]["mean_gauss"] == pytest.approx(made.mean(), rel=0.1)
    assert field["before"]["spread"] == pytest.approx(made.std() / made.mean(), rel=0.5)
    assert field["before"]["spread"] > 0.05

"""Magnetometer calibration inside a smoothing-and-mapping graph of one's own.

    python docs/guide/examples/smoothing_with_epochs.py

A vehicle has a magnetometer, a gyroscope, and another sensor that gives its attitude every 20 s to
1 degree (two satellite antennas and a level, say). One graph, grown epoch by epoch with iSAM2:

    c     calibration of the magnetometer    Vector(9)   ahrsd.epoch_factor, and a weak prior
    b k   gyro bias                          Vector(3)   ahrsd.epoch_factor, and a random walk
    u k   field direction in the sensor      Unit3       ahrsd.epoch_factor
    x k   attitude R_nb                      Rot3        the other sensor
    n     field direction in the world       Unit3       u k = x k^T n: the map, of one landmark

So the calibration, the direction of the local field (its declination and dip) and better attitudes
come out together. The readings are simulated: the truth is printed beside them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import MutableSequence, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, N, U, X
from numpy.typing import NDArray

from ahrsd.estimator.epoch_factor import Epoch, EpochKeys, Noise, Point, epoch_factor, summarise
from ahrsd.simulation import Experiment, ScenarioSettings, simulate
from ahrsd.so3 import skew

Array = NDArray[np.float64]

NOISE = Noise(mag_gauss=1e-3, gyro_rad_s=5e-3)
ATTITUDE_SIGMA_RAD = np.radians(1.0)
WALK_RAD_S = 1e-5  # of the gyro bias from epoch to epoch
TIE_RAD = 1e-4  # how exactly u k = x k^T n holds
UPPER = np.triu_indices(3)


@dataclass(frozen=True, slots=True)
class Result:
    """What came out, for the table and for a test."""

    values: gtsam.Values
    covariance: Array  # (9, 9) of c
    last_bias: Array
    again: Array  # c (9,) from the epochs' summaries alone
    attitude_error_deg: tuple[float, float]  # RMS of the other sensor, and of the graph


def field_tie(x: int, n: int, u: int) -> gtsam.CustomFactor:
    """u = R_nb^T n, with R_nb perturbed on the right as GTSAM's Rot3 is."""

    def error(
        _factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: MutableSequence[Array] | None
    ) -> Array:
        R_nb, north, here = values.atRot3(x), values.atUnit3(n), values.atUnit3(u)
        turned = R_nb.matrix().T @ north.point3()
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(skew(turned))
            jacobians[1] = np.asfortranarray(R_nb.matrix().T @ north.basis())
            jacobians[2] = np.asfortranarray(-np.array(here.basis()))
        return np.asarray(turned - here.point3())

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(3, TIE_RAD), [x, n, u], error)


class Smoother:
    """The graph as it grows: `add` takes one epoch and the attitude at its end."""

    def __init__(self, attitude_nb: Array, field_b_gauss: Array) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setOptimizationParams(gtsam.ISAM2DoglegParams())
        parameters.setRelinearizeThreshold(1e-6)  # of rad/s too, so it must be small
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        self.isam = gtsam.ISAM2(parameters)
        self.epochs: list[tuple[Epoch, EpochKeys]] = []
        self.others = gtsam.NonlinearFactorGraph()  # all factors but the epochs'
        c = np.r_[np.linalg.norm(field_b_gauss) * np.eye(3)[UPPER], np.zeros(3)]
        sigma = np.r_[np.full(6, 0.2), np.full(3, 0.3)]
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.addPriorVector(C(0), c, gtsam.noiseModel.Diagonal.Sigmas(sigma))
        graph.addPriorVector(B(0), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.02))
        values.insert(C(0), c)
        values.insert(B(0), np.zeros(3))
        u = gtsam.Unit3(field_b_gauss)
        values.insert(N(0), gtsam.Unit3(attitude_nb @ u.point3()))
        self._attitude(graph, values, 0, attitude_nb, u)
        self._first = (graph, values)  # only an epoch determines u 0
        self.values = values

    @staticmethod
    def _attitude(
        graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, k: int, R_nb: Array, u: gtsam.Unit3
    ) -> None:
        model = gtsam.noiseModel.Isotropic.Sigma(3, ATTITUDE_SIGMA_RAD)
        graph.add(gtsam.PriorFactorRot3(X(k), gtsam.Rot3(R_nb), model))
        graph.add(field_tie(X(k), N(0), U(k)))
        values.insert(X(k), gtsam.Rot3(R_nb))
        values.insert(U(k), u)

    def add(self, epoch: Epoch, attitude_nb: Array) -> None:
        """One more epoch."""
        k = len(self.epochs)
        keys = EpochKeys(C(0), B(k), U(k), U(k + 1))
        self.epochs.append((epoch, keys))
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if k == 0:
            graph, values = self._first
        else:
            model = gtsam.noiseModel.Isotropic.Sigma(3, WALK_RAD_S)
            graph.add(gtsam.BetweenFactorVector(B(k - 1), B(k), np.zeros(3), model))
            values.insert(B(k), self.values.atVector(B(k - 1)))
        n = np.array(self.values.atUnit3(N(0)).point3())
        self._attitude(graph, values, k + 1, attitude_nb, gtsam.Unit3(attitude_nb.T @ n))
        self.others.push_back(graph)
        graph.add(epoch_factor(epoch, keys))
        self.isam.update(graph, values)
        for _ in range(3):
            self.isam.update()
        self.values = self.isam.calculateEstimate()

    def from_summaries(self) -> gtsam.Values:
        """The same graph with each epoch as its summary around the estimate: no reading is kept."""
        graph = gtsam.NonlinearFactorGraph(self.others)
        for epoch, keys in self.epochs:
            graph.add(summarise(epoch, Point.of(self.values, keys)).factor(keys))
        return gtsam.GaussNewtonOptimizer(graph, self.values).optimize()


def smooth(experiment: Experiment, rows: int = 512) -> Result:
    """Epochs of `rows` readings, each sharing a reading with the next."""
    samples, rng = experiment.samples, np.random.default_rng(0)
    ends = np.arange(0, len(experiment), rows)
    noise = ATTITUDE_SIGMA_RAD * rng.standard_normal((len(ends), 3))
    attitude = [
        experiment.R_nb[end] @ gtsam.Rot3.Expmap(turn).matrix()
        for end, turn in zip(ends, noise, strict=True)
    ]
    smoother = Smoother(attitude[0], samples.raw_b_gauss[0])
    for k, (start, end) in enumerate(pairwise(ends.tolist())):
        part = slice(start, end + 1)
        epoch = Epoch.of(
            samples.raw_b_gauss[part],
            samples.gyro_b_rad_s[part],
            samples.dt_s[part],
            NOISE,
            follows=k > 0,
        )
        smoother.add(epoch, attitude[k + 1])
    values = smoother.values
    truth = [gtsam.Rot3(experiment.R_nb[end]) for end in ends]
    found = [values.atRot3(X(k)) for k in range(len(ends))]
    return Result(
        values,
        np.array(smoother.isam.marginalCovariance(C(0))),
        np.array(values.atVector(B(len(ends) - 2))),
        np.array(smoother.from_summaries().atVector(C(0))),
        (
            apart_deg(truth, [gtsam.Rot3(R) for R in attitude]),
            apart_deg(truth, found),
        ),
    )


def apart_deg(truth: list[gtsam.Rot3], found: list[gtsam.Rot3]) -> float:
    """RMS angle between attitudes."""
    turns = [gtsam.Rot3.Logmap(a.between(b)) for a, b in zip(truth, found, strict=True)]
    return float(np.degrees(np.sqrt(np.mean(np.sum(np.square(turns), axis=1)))))


def soft_iron(c: Array) -> Array:
    """A (3, 3) with det A = 1 of a calibration's M."""
    M = np.zeros((3, 3))
    M[UPPER] = c[:6]
    M = M + np.triu(M, 1).T
    return np.asarray(M / np.cbrt(np.linalg.det(M)))


def declination_dip_deg(n: Array) -> tuple[float, float]:
    """Of a direction in north, east, down."""
    return float(np.degrees(np.arctan2(n[1], n[0]))), float(np.degrees(np.arcsin(n[2])))


def report(result: Result, experiment: Experiment) -> list[str]:
    """Truth beside what was found."""
    truth, c = experiment.truth, np.array(result.values.atVector(C(0)))
    n = experiment.R_nb[0] @ experiment.field_b[0] / truth.field_gauss
    sigma = np.sqrt(np.diag(result.covariance))[6:]
    found_n = np.array(result.values.atUnit3(N(0)).point3())
    before, after = result.attitude_error_deg

    def line(name: str, true: Array, found: Array, digits: int) -> str:
        shown = [" ".join(f"{v:9.{digits}f}" for v in part) for part in (true, found)]
        return f"{name:<28} {shown[0]:<60} {shown[1]}"

    return [
        f"{'':<28} {'truth':<60} found",
        line("hard iron b, mG", 1e3 * truth.hard_iron_gauss, 1e3 * c[6:], 3),
        line("  its sigma", np.full(0, 0.0), 1e3 * sigma, 3),
        line("  from the summaries", np.full(0, 0.0), 1e3 * result.again[6:], 3),
        line("soft iron A, det A = 1", truth.soft_iron[UPPER], soft_iron(c)[UPPER], 5),
        line("gyro bias, mrad/s", 1e3 * truth.gyro_bias_rad_s, 1e3 * result.last_bias, 3),
        line(
            "declination and dip, deg",
            np.array(declination_dip_deg(n)),
            np.array(declination_dip_deg(found_n)),
            2,
        ),
        f"attitude error, deg RMS: {before:.2f} of the other sensor, {after:.2f} of the graph",
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate, smooth, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--scenario", default="mam", help="wam, mam or lam")
    parser.add_argument("--seconds", type=float, default=400.0)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    count = round(25.0 * chosen.seconds)
    experiment = simulate(ScenarioSettings(chosen.scenario, "rov", seed=chosen.seed, samples=count))
    sys.stdout.write("\n".join(report(smooth(experiment), experiment)) + "\n")


if __name__ == "__main__":
    main()

"""What an ideal observer could have seen of an effect, with the calibration estimated beside it.

The gyro turns the attitude, its noise makes that a random walk x in the world; the magnetometer
sees A [h]x R^T x beside the effect. Information on the effect, with A, b, w_b and the field as
nuisances, comes from one banded solve. Signal to noise is the root of the noncentrality.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.linalg import solveh_banded

from blind_trials.world.rotations import skew, to_world

_START = 1e2  # 1/rad^2: an attitude that is known to 0.1 rad; about the field it stays so


def observer(R_nb, h_b, soft_iron, step_s, sigma_mag, sigma_gyro):
    """A function of differences (mag (K,3), gyro (K,3)) -> column, and the Gram of columns."""
    H = soft_iron @ skew(h_b) @ np.swapaxes(R_nb, 1, 2)

    def column(mag, gyro):
        turned = np.cumsum(to_world(R_nb, gyro) * step_s, axis=0)
        return mag - np.einsum("kij,kj->ki", H, turned)

    def gram(columns, rows=slice(None), known_start=True):
        Z = np.stack(columns, axis=-1)[rows]
        lever = H[rows]
        K, _, p = Z.shape
        inner = np.einsum("kji,kjl->kil", lever, lever) / sigma_mag**2
        walk = 1.0 / (sigma_gyro * step_s) ** 2
        banded = np.zeros((4, 3 * K))
        for row in range(3):
            for lower in range(3 - row):
                banded[lower, row::3] += inner[:, row + lower, row]
        banded[0] += 2 * walk
        banded[0, -3:] -= walk
        if not known_start:
            banded[0, :3] -= walk - _START
        banded[3, : 3 * (K - 1)] = -walk
        projected = np.einsum("kji,kjp->kip", lever, Z).reshape(3 * K, p) / sigma_mag**2
        absorbed = projected.T @ solveh_banded(banded, projected, lower=True)
        flat = Z.reshape(3 * K, p)
        return flat.T @ flat / sigma_mag**2 - absorbed

    return column, gram


def nuisances(column, R_nb, h_b, soft_iron):
    """Columns of soft iron (6), hard iron (3), gyro bias (3) and the field in the world (3)."""
    none = np.zeros_like(h_b)
    out = []
    for i in range(3):
        unit = np.zeros(3)
        unit[i] = 1.0
        out.append(column(np.broadcast_to(unit, h_b.shape), none))
        out.append(column(none, np.broadcast_to(unit, h_b.shape)))
        out.append(column(np.einsum("ij,kj->ki", soft_iron, R_nb[:, i, :]), none))
        for j in range(i, 3):
            dA = np.zeros((3, 3))
            dA[i, j] = dA[j, i] = 1.0
            out.append(column(h_b @ dA.T, none))
    return out


def signal_to_noise(gram, wanted, others):
    """Root noncentralities of each wanted column alone, the other ones projected out."""
    G = gram([*others, *wanted])
    n = len(others)
    scale = np.sqrt(np.maximum(np.diag(G)[:n], 1e-300))
    inner = G[:n, :n] / np.outer(scale, scale)
    cross = G[:n, n:] / scale[:, None]
    left = np.diag(G)[n:] - np.sum(cross * (np.linalg.pinv(inner, rcond=1e-9) @ cross), axis=0)
    return np.sqrt(np.maximum(left, 0.0))


def held_out_gain(gram, wanted, others, samples, folds=5):
    """Nats per sample that knowing the effect gains on each fifth, the calibration fitted on the
    other four without it.
    """
    edges = np.linspace(0, samples, folds + 1).astype(int)
    columns = [*others, wanted]
    parts = [gram(columns, slice(a, b), known_start=False) for a, b in pairwise(edges)]
    whole, n, gain = sum(parts), len(others), 0.0
    for part in parts:
        train = whole - part
        scale = np.sqrt(np.maximum(np.diag(train)[:n], 1e-300))
        inverse = np.linalg.pinv(train[:n, :n] / np.outer(scale, scale), rcond=1e-7)
        absorbed = inverse @ (train[:n, n] / scale) / scale
        left = np.append(-absorbed, 1.0)
        gain += 0.5 * left @ part @ left
    return float(gain / samples)

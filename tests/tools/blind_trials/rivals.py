"""The rivals: what people reach for today, on the same recordings and the same covariates.

    stlsq      sequentially thresholded least squares (pysindy) on one-step residuals
    lasso-bic  LASSO path with BIC (scikit-learn) on the same columns
    ruptures   change points (PELT) of the one-step residuals

`python -m blind_trials.rivals TOOL CASE --spec FILE --json FILE`; each answers in the form of
`ahrsd diagnose --json`, with a name for every effect that keeps a coefficient. `TOOL --check` does
nothing but load the rival's package.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ahrsd.errors import EXIT_USAGE, AhrsdError
from ahrsd.estimator.online import Estimator
from ahrsd.recording.table import read_table
from ahrsd.samples import Array
from blind_trials import INSTALL
from blind_trials.rival_columns import Regression, regression

Json = dict[str, Any]

_THRESHOLD = 5.0  # standard deviations: the family-wise level of some 300 columns
_RIDGE = 0.05  # pysindy's default
_PENALTY = 3.0  # times the log of the number of points, for each of three axes: BIC's


def coefficients_stlsq(problem: Regression) -> Array:
    """pysindy's STLSQ; a coefficient's unit is its standard deviation under white residuals."""
    from pysindy.optimizers import STLSQ

    fit = STLSQ(threshold=_THRESHOLD, alpha=_RIDGE)
    fit.fit(problem.root, problem.target[:, None])
    return np.asarray(fit.coef_, dtype=np.float64).ravel()


def coefficients_lasso(problem: Regression) -> Array:
    """scikit-learn's LASSO path on Gram and correlations, the model of least BIC."""
    from sklearn.linear_model import lars_path_gram

    samples = len(problem.residual)
    _, _, path = lars_path_gram(
        problem.root.T @ problem.target,
        problem.root.T @ problem.root,
        n_samples=samples,
        method="lasso",
        max_iter=len(problem.names),
    )
    left = problem.root @ path - problem.target[:, None]
    outside = samples - problem.target @ problem.target  # of the residual, beyond all columns
    bic = samples * np.log((np.sum(left**2, axis=0) + outside) / samples)
    bic += np.count_nonzero(path, axis=0) * np.log(samples)
    return np.asarray(path[:, int(np.argmin(bic))], dtype=np.float64)


def change_points_s(problem: Regression) -> list[float]:
    """Times at which the mean residual of a second changes, by ruptures' PELT."""
    import ruptures

    second = np.floor(problem.time_s - problem.time_s[0]).astype(int)
    residual = problem.residual.reshape(-1, 3)
    counts = np.bincount(second)
    sums = np.stack([np.bincount(second, residual[:, i]) for i in range(3)], axis=1)
    means = sums[counts > 0] / counts[counts > 0, None]
    means = means / means.std(axis=0)
    found = ruptures.Pelt(model="l2", min_size=3, jump=1).fit(means)
    ends = found.predict(pen=_PENALTY * 3 * np.log(len(means)))
    return [float(problem.time_s[0] + end) for end in ends[:-1]]


def _sparse(problem: Regression, fit: Callable[[Regression], Array]) -> Json:
    strength: dict[str, float] = {}
    for name, coefficient in zip(problem.names, fit(problem), strict=True):
        if coefficient != 0:
            strength[name] = strength.get(name, 0.0) + float(coefficient) ** 2
    ranked = sorted(strength, key=lambda name: -strength[name])
    return _answer([(name, strength[name] / sum(strength.values()), None) for name in ranked])


def _stepped(problem: Regression) -> Json:
    found = change_points_s(problem)
    end = float(problem.time_s[-1])
    return _answer([("hard_iron_step", 1.0, [found[0], end])] if found else [])


def _answer(found: list[tuple[str, float, list[float] | None]]) -> Json:
    findings = [
        {
            "effect": name,
            "confidence": share,
            "alternatives": [],
            "where": {"intervals_s": [] if span is None else [span], "frame": None},
            "parameters": [],
        }
        for name, share, span in found
    ]
    return {
        "schema": "ahrsd.diagnosis/1",
        "mismatch": bool(findings),
        "findings": findings,
        "unexplained": {"detected": False, "where": None},
    }


_TOOLS: dict[str, Callable[[Regression], Json]] = {
    "stlsq": lambda problem: _sparse(problem, coefficients_stlsq),
    "lasso-bic": lambda problem: _sparse(problem, coefficients_lasso),
    "ruptures": _stepped,
}


_MODULES = {"stlsq": "pysindy", "lasso-bic": "sklearn", "ruptures": "ruptures"}


def _missing(tool: str, error: ImportError) -> AhrsdError:
    name = error.name or _MODULES[tool]
    return AhrsdError(f"{tool} needs {name}; install it in the checkout: {INSTALL}")


def check(tool: str) -> None:
    """Load the rival's package.  AhrsdError where it is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            importlib.import_module(_MODULES[tool])
    except ImportError as error:
        raise _missing(tool, error) from error


def answer(tool: str, case: Path) -> Json:
    """A rival's answer.  AhrsdError where the recording or the rival's package will not do."""
    table = read_table(case, check_units=False)
    estimator = Estimator()
    for block in table.blocks():
        estimator.add(block)
    estimate = estimator.finish()
    if estimate is None:
        return _answer([])
    try:
        with warnings.catch_warnings():  # that nothing is left, or that columns are alike
            warnings.simplefilter("ignore")
            return _TOOLS[tool](regression(table, estimate))
    except ImportError as error:
        raise _missing(tool, error) from error


def main(arguments: list[str] | None = None) -> None:
    """The program."""
    parser = argparse.ArgumentParser(prog="blind_trials.rivals", description=__doc__)
    parser.add_argument("tool", choices=sorted(_TOOLS))
    parser.add_argument("case", type=Path, nargs="?")
    parser.add_argument("--check", action="store_true", help="only: is its package installed?")
    parser.add_argument("--spec", type=Path, help="not used: the rivals know of no noise")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args(arguments)
    if not asked.check and None in (asked.case, asked.json):
        parser.error("a case and --json are needed")
    try:
        if asked.check:
            check(asked.tool)
            return
        said = answer(asked.tool, asked.case)
        asked.json.write_text(json.dumps(said, allow_nan=False), encoding="utf-8")
    except (AhrsdError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        raise SystemExit(EXIT_USAGE) from error


if __name__ == "__main__":
    main()

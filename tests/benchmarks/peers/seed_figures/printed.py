"""What [R] and [L] print, and when a figure of ours counts as the same."""

from __future__ import annotations

from typing import Any

import numpy as np

NAMES = ("a0", "a1", "a2", "a3", "a4", "a5", "m_bx", "m_by", "m_bz", "w_bx", "w_by", "w_bz")
RUNS = 100  # behind each mean of Tables 5.1 and 5.2

#: [R] Table 5.1 as text: a0..a5 | m_b in mG | w_b in mrad/s; "fails" where it has no answer
TABLE_5_1 = {
    "wam": {
        "LS": "1.024 .068 .031 .874 .015 1.125 | 19.101 119.609 89.008",
        "NLS": "1.024 .068 .031 .875 .015 1.124 | 19.873 119.238 88.502 | 4.083 -5.027 1.935",
        "BFG": "1.043 .094 .038 .835 .019 1.161 | 19.450 114.952 88.328 | 3.963 -4.800 1.812",
        "TWOSTEP": "1.045 .095 .038 .836 .019 1.159 | 19.944 120.034 90.029",
        "Ellipsoid fit": ".981 -.096 -.041 1.153 .133 .907 | 19.946 120.013 90.042",
        "IFG": "1.043 .094 .038 .836 .019 1.161 | 18.954 115.106 88.004 | 1.775 -2.136 .852",
        "MagFactor3": "1 0 0 1 0 1 | 21.733 64.467 63.398",
    },
    "mam": {
        "LS": "1.037 .040 .009 .945 .004 1.022 | 36.233 126.694 144.367",
        "NLS": "1.034 .039 .009 .946 .004 1.024 | 37.295 126.736 138.168 | 3.930 -4.980 1.972",
        "BFG": "1.046 .094 .040 .834 .018 1.160 | 16.839 115.233 83.569 | 3.761 -4.771 1.946",
        "TWOSTEP": "fails",
        "Ellipsoid fit": ".976 -.090 -.048 1.127 .149 .937 | 19.711 120.385 106.324",
        "IFG": "1.051 .093 .039 .842 .017 1.143 | 17.023 114.880 90.611 | 1.557 -1.967 .938",
        "MagFactor3": "1 0 0 1 0 1 | 26.068 34.451 105.456",
    },
    "lam": {
        "LS": "1.012 .007 .002 .991 .000 .997 | 70.928 155.958 261.968",
        "NLS": "1.009 .007 .003 .992 .000 .999 | 72.205 147.713 169.811 | 4.095 -4.929 2.099",
        "BFG": "1.078 .086 .024 .837 .012 1.119 | 12.191 117.941 88.120 | 3.904 -4.791 2.030",
        "TWOSTEP": "fails",
        "Ellipsoid fit": ".744 -.041 .232 .503 .023 2.762 | 66.652 133.566 228.005",
        "IFG": "1.104 .082 .015 .898 .008 1.016 | 24.034 121.612 163.677 | 1.594 -1.581 1.216",
        "MagFactor3": "1 0 0 1 0 1 | -6.282 57.361 130.686",
    },
}
#: [R] Table 5.2: heading RMSE in deg, standard deviation of the field in mG; None: fails
TABLE_5_2: dict[str, tuple[tuple[float, float] | None, ...]] = {
    "LS": ((3.703, 13.516), (5.300, 23.997), (14.368, 61.142)),
    "NLS": ((3.761, 13.680), (5.521, 24.607), (9.320, 41.981)),
    "BFG": ((2.659, 9.794), (2.735, 9.875), (3.812, 16.016)),
    "TWOSTEP": ((2.518, 9.421), None, None),
    "Ellipsoid fit": ((18.232, 62.522), (16.235, 60.211), (50.842, 157.802)),
    "IFG": ((2.654, 9.762), (2.791, 10.371), (3.528, 17.552)),
    "MagFactor3": ((15.915, 45.192), (16.917, 49.603), (14.431, 48.784)),
}
#: [R]'s seconds for 400 s of data
SECONDS = {"LS": "1.4", "NLS": "1.4", "IFG": ".8", "BFG": ".3 (WAM) to .8 (LAM)"}
#: [R] Table 6.2, of the real dive
TABLE_6_2 = {
    "exp1": {
        "BFG": "1.007 .000 .011 1.030 .004 .964 | -7.509 25.211 -.732 | .175 -.101 .490",
        "IFG": "1.013 .000 .011 1.035 .004 .954 | -7.431 25.107 5.238 | .162 -.103 .515",
        "TWOSTEP": "fails",
        "Ellipsoid fit": ".725 -.006 -.001 1.861 .041 .742 | -3.003 14.301 332.575",
        "MagFactor3": "1 0 0 1 0 1 | -5.926 19.544 -29.264",
    },
    "exp2": {
        "BFG": ".973 -.007 .029 1.009 -.040 1.021 | -16.870 45.694 -47.413 | .265 -.070 .746",
        "IFG": ".970 -.008 .030 1.006 -.041 1.028 | -17.167 46.534 -51.592 | .271 -.013 .729",
        "MagFactor3": "1 0 0 1 0 1 | 2.717 2.464 -21.951",
    },
}
#: [R] chapter 6: heading error in deg, dead reckoning in percent of 1,395 m, in its words
DIVE = {
    "raw": ("6.33", "10 (138 m)"),
    "LS": ("< 1.53", "< .54"),
    "NLS": ("< 1.53", "< .54"),
    "BFG": ("< 1.53", "< .54"),
    "IFG": ("< 1.53", "< .54"),
    "Ellipsoid fit": ("", ".67"),
    "TWOSTEP": ("fails", "fails"),
}
L_MEANS = {"tls": (0.0374, -0.0411, -0.0397), "fnp": (0.0344, -0.0407, -0.0363)}
L_AHEAD = (7.2, 6.0, 6.7)


def numbers(text: str) -> dict[str, list[str]]:
    """Of a row of 5.1 or 6.2, the printed words of "a", "m_b" and "w_b" ([] where it has none)."""
    parts = [part.split() for part in text.split("|")]
    return dict(zip(("a", "m_b", "w_b"), [*parts, [], []], strict=False))


def decimals(word: str) -> int:
    """Digits behind the point."""
    return len(word.partition(".")[2])


def verdict(word: str, mean: float, std: float, answers: int) -> str:
    """How a printed mean of 100 runs compares with ours.

    "same": no further apart than three standard errors of the two means and the last printed digit;
    "near": within one standard deviation of a single run; else "other".
    """
    apart = abs(float(word) - mean)
    error = 3 * std * np.sqrt(1 / answers + 1 / RUNS) + 0.5 * 10.0 ** -decimals(word)
    if apart <= error:
        return "same"
    return "near" if apart <= std else "other"


def marked(word: str, said: dict[str, Any], position: int | None = None) -> tuple[str, str]:
    """Ours beside a printed word, bold where the same and italic where near, and the verdict."""
    mean, std = said["mean"], said["std"]
    if position is not None:
        mean, std = mean[position], std[position]
    found = verdict(word, mean, std, said["of"])
    digits = decimals(word)
    text = f"{mean:.{digits}f}"
    around = {"same": "**", "near": "*", "other": ""}[found]
    return f"{around}{text}{around} ± {std:.{digits}f}", found

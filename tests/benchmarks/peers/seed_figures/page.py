"""The page of the seeds' figures: `page.md`, with tables from the summary of the runs."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from seed_figures import printed
from seed_figures.dive import HARD_IRON_MG

TEMPLATE = Path(__file__).with_name("page.md")
Said = dict[str, Any]
SETS = ("wam", "mam", "lam")


def page(figures: Said) -> str:
    """The whole page: `page.md` with tables and figures put in."""
    environment = Environment(
        undefined=StrictUndefined, autoescape=False, keep_trailing_newline=True
    )
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    tables = {
        function.__name__: "\n".join(function(figures))
        for function in (
            shorts, table_5_1, table_5_2, growing, seconds, figure_4, dive, table_6_2, mean_errors,
            over_noise, over_bias, varying,
        )
    }  # fmt: skip
    slow = figures["chapter5"]["slow"]
    motions = figures["norms"]["noise"]["motions"]
    return template.render(
        tables,
        judge=figures["judge"],
        runs={kind: slow[kind]["seeds"][1] + 1 for kind in SETS},
        dives=figures["dive"]["without"]["raw"]["runs"],
        methods={kind: slow[kind]["methods"] for kind in SETS},
        of=figures["dive"],
        norms=figures["norms"]["mean_errors"],
        variance=[x for row in motions for x in row["variance_ahead_percent"]],
        even=motions[0]["ahead_percent"],
        value=value,
        worst_heading=max(
            said["heading_deg"]["mean"]
            for name, said in figures["dive"]["exp1"].items()
            if name in ("LS", "NLS", "BFG", "IFG") and said["answers"]
        ),
        parts_of_exp1=_three(figures["dive"]["parts"]["median_deg"], 2),
        scaled_iron=_three([figures["dive"]["hard_iron_scale"] * b for b in HARD_IRON_MG], 3),
    )


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    """A table of the page."""
    return [_row(head), "|" + "---|" * len(head), *(_row(row) for row in rows)]


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def value(
    said: Said, key: str, digits: int, what: str = "mean", position: int | None = None
) -> str:
    """A mean or standard deviation over the answers; "-" where there is none."""
    if key not in said:
        return "-"
    found = said[key][what]
    return f"{found if position is None else found[position]:.{digits}f}"


def number(said: Said, key: str, digits: int = 2) -> str:
    """Mean and standard deviation over the answers; "-" without."""
    if key not in said:
        return "-"
    mean, std = said[key]["mean"], said[key]["std"]
    return f"{mean:.{digits}f}" + (f" ± {std:.{digits}f}" if said[key]["of"] > 1 else "")


def answers(said: Said) -> str:
    """Of how many runs; the commonest failure."""
    text = f"{said['answers']}/{said['runs']}"
    if said["failures"]:
        words, _ = max(said["failures"].items(), key=lambda item: item[1])
        text += f" ({words.split(':')[0]})"
    return text


# -- [R] chapter 5 ---------------------------------------------------------------------------------


def _of_chapter_5(figures: Said, kind: str, motion: str = "slow") -> Said:
    found: Said = figures["chapter5"][motion][kind]["methods"]
    return found


def compared(words: str, said: Said) -> tuple[list[str], Counter[str]]:
    """Twelve cells of ours beside a printed row, and how often which verdict."""
    cells, verdicts = [], Counter[str]()
    for key, values in printed.numbers(words).items():
        for k in range(6 if key == "a" else 3):
            if key not in said:
                cells.append("-")
            elif not values:
                cells.append(f"{said[key]['mean'][k]:.3f}")
            else:
                text, verdict = printed.marked(values[k], said[key], k)
                cells.append(text)
                verdicts[verdict] += 1
    return cells, verdicts


def _printed_cells(words: str) -> list[str]:
    if words == "fails":
        return ["fails"] + [""] * 11
    parts = printed.numbers(words)
    return [
        *parts["a"], *(parts["m_b"]), *(parts["w_b"] or ["-"] * 3)
    ]  # fmt: skip


def table_5_1(figures: Said) -> list[str]:
    """[R]'s rows and ours below each."""
    rows = []
    for kind, methods in printed.TABLE_5_1.items():
        here = _of_chapter_5(figures, kind)
        for method, words in methods.items():
            said = here[method]
            rows.append([kind.upper(), method, "[R]", *_printed_cells(words)])
            if words == "fails" and said["answers"]:
                cells = [f"{x:.3f}" for x in [*said["a"]["mean"], *said["m_b"]["mean"]]]
                cells += ["-"] * 3
            else:
                cells = compared(words, said)[0] if words != "fails" else [""] * 12
            rows.append(["", "", answers(said), *cells])
    return table(["set", "method", "", *printed.NAMES], rows)


def table_5_2(figures: Said) -> list[str]:
    """Heading RMSE and standard deviation of the field, printed and here."""
    head = ["method"]
    head += [f"{kind.upper()}, {who}" for kind in SETS for who in ("[R]", "here")]
    rows = []
    for method, values in printed.TABLE_5_2.items():
        row = [method]
        for kind, pair in zip(SETS, values, strict=True):
            said = _of_chapter_5(figures, kind)[method]
            if pair is None:
                row += ["fails", _pair(said) if said["answers"] else "fails"]
                continue
            heading, field = pair
            row.append(f"{heading:.3f} / {field:.3f}")
            row.append(
                f"{printed.marked(f'{heading:.3f}', said['heading_deg'])[0]} / "
                f"{printed.marked(f'{field:.3f}', said['field_std_mg'])[0]}"
                if said["answers"]
                else "fails"
            )
        rows.append(row)
    others = [name for name in _of_chapter_5(figures, "wam") if name not in printed.TABLE_5_2]
    for method in others:
        row = [method]
        for kind in SETS:
            said = _of_chapter_5(figures, kind)[method]
            row += ["", _pair(said) if said["answers"] else "fails"]
        rows.append(row)
    judge = figures["judge"]
    for name in ("raw", "exact"):
        values = judge[name]
        text = f"{values['heading_deg']:.3f} / {values['field_std_mg']:.3f}"
        words = "28.864 / 60.330" if name == "raw" else ""
        rows.append([f"{name} parameters" if name == "exact" else name, *[words, text] * 3])
    return table(head, rows)


def _pair(said: Said) -> str:
    return f"{number(said, 'heading_deg', 3)} / {number(said, 'field_std_mg', 3)}"


def growing(figures: Said) -> list[str]:
    """The incremental graph on parts of the data."""
    head = ["IFG, median heading RMSE in deg", *(f"{p} %" for p in range(10, 110, 10))]
    rows = []
    for kind, said in figures["parts"].items():
        cells = [
            "-" if value is None else f"{value:.2f}" + (f" ({n})" if n < said["runs"] else "")
            for value, n in zip(said["median_deg"], said["answers"], strict=True)
        ]
        rows.append([f"{kind.upper()}, {said['runs']} runs", *cells])
    return table(head, rows)


def seconds(figures: Said) -> list[str]:
    """Processing time of 400 s of data."""
    names = [*printed.TABLE_5_2, "ours"]
    rows = [
        [name, printed.SECONDS.get(name, ""),
         *(_seconds(_of_chapter_5(figures, kind)[name]) for kind in SETS)]
        for name in names
    ]  # fmt: skip
    head = ["CPU s for 400 s of data", "[R]", *(f"here, {kind.upper()}" for kind in SETS)]
    return table(head, rows)


def _seconds(said: Said) -> str:
    return f"{said['cpu_s']['mean']:.2f}" if "cpu_s" in said else "fails"


def figure_4(figures: Said) -> list[str]:
    """[M]'s three kinds of error, by method and set."""
    head = ["method"]
    for kind in SETS:
        head += [f"{kind.upper()} answers", "geodesic", "hard iron mG", "gyro mrad/s"]
    names = figures["figure 4"]["wam"]["methods"]
    rows = []
    for name in names:
        row = [name]
        for kind in SETS:
            said = figures["figure 4"][kind]["methods"][name]
            row += [
                f"{said['answers']}/{said['runs']}", number(said, "geodesic", 4),
                number(said, "hard_iron_mg", 2), number(said, "gyro_mrad_s", 3),
            ]  # fmt: skip
        rows.append(row)
    return table(head, rows)


# -- [R] chapter 6 ---------------------------------------------------------------------------------


def dive(figures: Said) -> list[str]:
    """Heading and dead reckoning by method."""
    head = [
        "calibrated on", "method", "answers", "heading [R], deg", "here",
        "dead reckoning [R], %", "here, of the INS' way", "here, of the true way",
    ]  # fmt: skip
    of = figures["dive"]
    rows = []
    for name, said in of["without"].items():
        heading, way = printed.DIVE.get(name, ("", ""))
        rows.append(["-", name, answers(said), heading, *_dive_cells(said, way)])
    for on in ("exp1", "exp2"):
        for name, said in of[on].items():
            heading, way = printed.DIVE.get(name, ("", "")) if on == "exp1" else ("", "")
            rows.append([on.upper(), name, answers(said), heading, *_dive_cells(said, way)])
    return table(head, rows)


def _dive_cells(said: Said, way: str) -> list[str]:
    ins, true = "worst_ins_percent", "worst_true_percent"
    return [number(said, "heading_deg", 3), way, number(said, ins, 3), number(said, true, 3)]


def table_6_2(figures: Said) -> list[str]:
    """Parameters of the real dive and of the simulated one."""
    rows = []
    for on, methods in printed.TABLE_6_2.items():
        here = figures["dive"][on]
        for name, words in methods.items():
            rows.append([on.upper(), name, "[R]", *_printed_cells(words)])
            for same in (name, f"{name}, unchecked"):
                if same in here:
                    rows.append(["", same, answers(here[same]), *_parameters(here[same])])
        if "ours" in here:
            rows.append([on.upper(), "ours", answers(here["ours"]), *_parameters(here["ours"])])
    return table(["set", "method", "", *printed.NAMES], rows)


def _parameters(said: Said) -> list[str]:
    out = []
    for key, size in (("a", 6), ("m_b", 3), ("w_b", 3)):
        out += [f"{x:.3f}" for x in said[key]["mean"]] if key in said else ["-"] * size
    return out


# -- [L] -------------------------------------------------------------------------------------------


def _three(values: list[float | None], digits: int = 4) -> str:
    return ", ".join("-" if value is None else f"{value:.{digits}f}" for value in values)


def mean_errors(figures: Said) -> list[str]:
    """Mean bias errors, constraint errors and CPU of every method and ours."""
    rows = []
    for name, said in figures["norms"]["mean_errors"].items():
        words = printed.L_MEANS.get(name)
        rms = np.sqrt(said["mean_square"]).tolist()
        rows.append(
            [
                f"`{name}`", f"{said['runs'] - said['failed']}/{said['runs']}",
                _three(list(words)) if words else "", _three(said["mean"]),
                _three(said["standard_error"]), _three(rms, 3),
                f"{said['constraint']:.1e}" if "constraint" in said else "-",
                f"{said['ms']:.2f}",
            ]
        )  # fmt: skip
    head = ["method", "answers", "mean bias error [L], mG", "here", "its standard error",
            "RMS of a run", "constraint error, mG", "CPU, ms"]  # fmt: skip
    return table(head, rows)


def over_noise(figures: Said) -> list[str]:
    """SSE of TLS and Method 2 over noise, and over motions at the largest."""
    said = figures["norms"]["noise"]
    rows = [
        [f"{row['noise']}", _three(row["tls"], 0), _three(row["fnp"], 0),
         _three(row["ahead_percent"], 1)]
        for row in said["table"]
    ]  # fmt: skip
    head = ["noise, mG", f"SSE of TLS, x y z, mG², {said['runs']} runs", "of Method 2",
            "Method 2 ahead by, %"]  # fmt: skip
    motions = [
        ["evenly random" if row["motion"] < 0 else str(row["motion"]), f"{row['unevenness']:.2f}",
         _three(row["ahead_percent"], 1), _three(row["variance_ahead_percent"], 1),
         _three(row["mean_tls"], 2), _three(row["mean_fnp"], 2)]
        for row in said["motions"]
    ]  # fmt: skip
    others = ["motion, 50 mG", "mean direction", "Method 2 ahead in SSE, %", "in variance, %",
              "mean error of TLS, mG", "of Method 2"]  # fmt: skip
    return [*table(head, rows), "", *table(others, motions)]


def over_bias(figures: Said) -> list[str]:
    """SSE over bias, and other minima."""
    rows = [
        [f"{row['bias']}"]
        + [
            cell
            for name in ("tls", "fnp")
            for cell in (
                f"{row[name]['sse']:.4f}", f"{row[name]['sse_general']:.4f}",
                f"{row[name]['general_elsewhere']}",
                f"{row[name]['elsewhere']}"
                + (f" (cost x {row[name]['lowest']:.0f})" if row[name]["lowest"] else ""),
            )
        ]
        for row in figures["norms"]["bias"]
    ]  # fmt: skip
    head = ["bias, mG"]
    for name in ("TLS", "Method 2"):
        head += [
            f"{name}: SSE, mG²",
            "by SLSQP from 0",
            "its runs elsewhere",
            "far starts elsewhere",
        ]
    return table(head, rows)


def varying(figures: Said) -> list[str]:
    """The field that is not constant."""
    rows = []
    for name, said in figures["norms"]["varying"].items():
        method, _, told = name.partition(", ")
        rms = np.sqrt(said["mean_square"]).tolist()
        given = "its mean" if told == "constant" else "as measured, 5 mG"
        rows.append([f"`{method}`", given, _three(said["mean"], 2), _three(rms, 2)])
    return table(["method", "is given the field's size", "mean bias error, mG", "RMS, mG"], rows)


# -- in short --------------------------------------------------------------------------------------


def shorts(figures: Said) -> list[str]:
    """One row a group of figures: printed, here, how many are the same."""
    rows = []
    for method in printed.TABLE_5_2:
        verdicts: dict[str, Counter[str]] = {}
        for kind in SETS:
            words, said = printed.TABLE_5_1[kind][method], _of_chapter_5(figures, kind)[method]
            if words == "fails":
                verdicts[kind] = Counter({"fails here too" if not said["answers"] else
                                          "fails there, answers here": 1})  # fmt: skip
                continue
            verdicts[kind] = compared(words, said)[1] if said["answers"] else Counter(failed=1)
        rows.append([f"Table 5.1, {method}", *(_told(verdicts[kind]) for kind in SETS)])
    for method, pairs in printed.TABLE_5_2.items():
        row = []
        for kind, pair in zip(SETS, pairs, strict=True):
            said = _of_chapter_5(figures, kind)[method]
            if pair is None or not said["answers"]:
                row.append("fails here too" if not said["answers"] else "fails there, answers here")
                continue
            keys = zip(pair, ("heading_deg", "field_std_mg"), strict=True)
            row.append(_told(Counter(printed.marked(f"{w:.3f}", said[k])[1] for w, k in keys)))
        rows.append([f"Table 5.2, {method}", *row])
    return table(["figures", *(kind.upper() for kind in SETS)], rows)


def _told(verdicts: Counter[str]) -> str:
    order = [word for word in ("same", "near", "other") if verdicts[word]]
    if not order:
        return ", ".join(verdicts)
    return ", ".join(f"{verdicts[word]} {word}" for word in order)

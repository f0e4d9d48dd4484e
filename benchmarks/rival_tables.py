"""The tables of rivals.json, in Markdown."""

from typing import Any

from benchmark import circumstances

COLUMNS = (
    "rival",
    "program",
    "basis",
    "steps",
    "time [ms]",
    "CPU [ms]",
    "µs/step",
    "ratio to lgsens: time",
    "CPU",
    "build [s]",
    "memory [MB]",
    "error of Ψ",
    "error of gradient",
)


def _number(record: dict[str, Any], key: str, form: str, scale: float = 1.0) -> str:
    value = record.get(key)
    return "–" if value is None else format(scale * value, form)


def _row(record: dict[str, Any]) -> str:
    error = _number(record, "gradient_error", ".1e")
    if error == "–" and "gradient_difference_from_lgsens" in record:
        error = f"{record['gradient_difference_from_lgsens']:.1e} (from lgsens)"
    value_error = _number(record, "value_error", ".1e")
    if value_error == "–" and "value_difference_from_lgsens" in record:
        value_error = f"{record['value_difference_from_lgsens']:.1e} (from lgsens)"
    cells = (
        record["rival"],
        record["program"],
        record["basis"],
        str(record["num_steps"]),
        _number(record, "seconds", ".3g", 1e3),
        _number(record, "cpu_seconds", ".3g", 1e3),
        _number(record, "microseconds_per_step", ".3g"),
        _number(record, "ratio_to_lgsens", ".2f"),
        _number(record, "cpu_ratio_to_lgsens", ".2f"),
        _number(record, "build_seconds", ".1f"),
        _number(record, "temporary_bytes", ".2f", 1e-6),
        value_error,
        error,
    )
    return "| " + " | ".join(cells) + " |"


def _summary(found: dict[str, Any]) -> list[str]:
    """Processor time and its ratio to lgsens's, of the fastest program of each rival and kind of work.

    In brackets what a rival without derivatives needs for one-sided differences: 1 + its parameters forward runs.
    """
    programs = found["programs"]
    kinds = list(dict.fromkeys(record["kind"] for record in programs))
    rows = list(dict.fromkeys((record["rival"], record["basis"]) for record in programs))
    lines = ["| CPU [ms] (ratio to lgsens) | " + " | ".join(kinds) + " |", "|---" * (1 + len(kinds)) + "|"]
    runs = 1 + len(found["parameters"])

    def fastest(rival, basis, kind) -> float | None:
        times = [r["cpu_seconds"] for r in programs if (r["rival"], r["basis"], r["kind"]) == (rival, basis, kind)]
        return min(times, default=None)

    own = {kind: fastest("lgsens", "equal step", kind) for kind in kinds}
    for rival, basis in rows:
        cells = []
        differences = not any(r["rival"] == rival and r["kind"].startswith("gradient") for r in programs)
        for kind in kinds:
            seconds, form = fastest(rival, basis, kind), "{:.3g} ({:.2g})"
            if seconds is None and differences and kind == "gradient, p":
                seconds, form = runs * fastest(rival, basis, "forward"), "[{:.3g} ({:.2g})]"
            unit = own[kind]
            cells.append("–" if seconds is None or unit is None else form.format(1e3 * seconds, seconds / unit))
        lines.append(f"| {rival}, {basis} | " + " | ".join(cells) + " |")
    return lines


def _scene(name: str, found: dict[str, Any]) -> list[str]:
    lines = [
        f"### {name}",
        "",
        f"{found['bodies']} bodies, t = 0 … {found['t1']:g} s, Ψ = {found['criterion']}, p: {len(found['parameters'])} "
        f"parameters. Medians of {found['repeats']} rounds; {circumstances(found['environment'])}",
    ]
    if found["failed"]:
        lines += ["", "Failed: " + ", ".join(f"{rival} ({error})" for rival, error in found["failed"].items()) + "."]
    lines += ["", *_summary(found)]
    for kind in dict.fromkeys(record["kind"] for record in found["programs"]):
        lines += ["", f"**{kind}**", "", "| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
        lines += [_row(record) for record in found["programs"] if record["kind"] == kind]
    return lines


def markdown(document: dict[str, Any]) -> str:
    """All scenes, a table for each kind of work."""
    blocks = ["\n".join(_scene(name, found)) for name, found in document["scenes"].items()]
    return "\n\n".join(blocks)

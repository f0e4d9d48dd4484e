"""The tables of rivals.json, in Markdown."""

from typing import Any

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
    if "gradient_difference_from_lgsens" in record:
        error = f"{record['gradient_difference_from_lgsens']:.1e} (from lgsens)"
    value_error = _number(record, "value_error", ".1e")
    if "value_difference_from_lgsens" in record:
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


def _scene(name: str, found: dict[str, Any]) -> list[str]:
    environment = found["environment"]
    versions = ", ".join(f"{package} {version}" for package, version in environment["versions"].items())
    machine = environment["machine"]
    lines = [
        f"### {name}",
        "",
        f"{found['bodies']} bodies, t = 0 … {found['t1']:g} s, Ψ = {found['criterion']}, p: {len(found['parameters'])} "
        f"parameters. {environment['date']}, {machine['architecture']}, {machine['cores']} cores, load average "
        f"{environment['load_average']}, one thread, medians of {found['repeats']} rounds; {versions}.",
    ]
    for kind in dict.fromkeys(record["kind"] for record in found["programs"]):
        lines += ["", f"**{kind}**", "", "| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
        lines += [_row(record) for record in found["programs"] if record["kind"] == kind]
    return lines


def markdown(document: dict[str, Any]) -> str:
    """All scenes, a table for each kind of work."""
    blocks = ["\n".join(_scene(name, found)) for name, found in document["scenes"].items()]
    return "\n\n".join(blocks)

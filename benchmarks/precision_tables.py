"""The table and the plot of work_precision.json."""

from pathlib import Path
from typing import Any

from benchmark import circumstances

COLUMNS = (
    "error at most",
    "family",
    "settings",
    "steps",
    "error of Ψ",
    "error of gradient",
    "time [ms]",
    "CPU [ms]",
    "ratio to best lgsens: time",
    "CPU",
)


def fastest(records: list[dict[str, Any]], level: float) -> dict[str, Any] | None:
    """The fastest program with an error of at most `level`."""
    return min((r for r in records if r["gradient_error"] <= level), key=lambda r: r["seconds"], default=None)


def _rows(found: dict[str, Any]) -> list[str]:
    records, lines = found["programs"], []
    families = list(dict.fromkeys(r["rival"] for r in records))
    for level in found["levels"]:
        best = fastest([r for r in records if r["rival"].startswith("lgsens")], level)
        for family in families:
            record = fastest([r for r in records if r["rival"] == family], level)
            if record is None:
                cells = ("not reached", *("–",) * 6)
            else:
                ratios = ("–", "–")
                if best is not None:
                    ratios = tuple(f"{record[key] / best[key]:.2f}" for key in ("seconds", "cpu_seconds"))
                cells = (
                    record["program"],
                    str(record["num_steps"]) if record["num_steps"] > 1 else "–",
                    *(f"{record[key]:.1e}" for key in ("value_error", "gradient_error")),
                    *(f"{1e3 * record[key]:.3g}" for key in ("seconds", "cpu_seconds")),
                    *ratios,
                )
            name = f"**{family}**" if record is best and best is not None else family
            lines.append("| " + " | ".join((f"{level:.0e}", name, *cells)) + " |")
    return lines


def markdown(document: dict[str, Any]) -> str:
    """All scenes, a table for each."""
    blocks = []
    for name, found in document["scenes"].items():
        blocks.append(
            "\n".join(
                [
                    f"### {name}",
                    "",
                    f"Gradient with respect to {found['parameters']} parameters. Medians of {found['repeats']} rounds; "
                    f"{circumstances(found['environment'])}",
                    *(f"\nDid not finish: {name}." for name in found.get("failed", ())),
                    "",
                    f"![error against time](../../benchmarks/results/work_precision_{name}.png)",
                    "",
                    "| " + " | ".join(COLUMNS) + " |",
                    "|---" * len(COLUMNS) + "|",
                    *_rows(found),
                ]
            )
        )
    return "\n\n".join(blocks)


def plot(found: dict[str, Any], path: Path) -> None:
    """Error of the gradient against time, both logarithmic, a line for each family."""
    from lgsens import plotting

    figure = plotting.figure(8.4, 5.0)
    axes = figure.add_subplot()
    for i, family in enumerate(dict.fromkeys(r["rival"] for r in found["programs"])):
        points = sorted((r["gradient_error"], 1e3 * r["seconds"]) for r in found["programs"] if r["rival"] == family)
        # the front: no other program of the family is both faster and more accurate
        front = [p for p in points if not any(q[0] <= p[0] and q[1] < p[1] for q in points)]
        (line,) = axes.loglog(*zip(*front), marker="osD^vX"[i % 6], label=family)
        rest = [p for p in points if p not in front]
        if rest:
            axes.loglog(*zip(*rest), marker="osD^vX"[i % 6], color=line.get_color(), linestyle="", alpha=0.3)
    axes.invert_xaxis()
    axes.set_xlabel("relative error of dΨ/dp")
    axes.set_ylabel("time of Ψ and dΨ/dp [ms]")
    axes.grid(which="both", alpha=0.3)
    figure.legend(loc="outside right upper", frameon=False)
    plotting.save(figure, path)

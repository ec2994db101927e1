"""Learning curves of several runs of `upcr train` side by side, as SVG: held-out loss and rotation error over the steps."""

import argparse
import csv
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt

# The palette of the reports (web/report/style.css), and marks for those who print in grey.
TEXT, QUIET_TEXT, LINE, CANVAS = "#1b2126", "#5a656e", "#d9dee2", "#f2f4f5"
COLOURS = ["#cf5f0c", "#11678f", "#5f8a1d", "#7d55b5", "#b8447e", "#6b6357"]
MARKS = ["o", "s", "^", "D", "v", "P"]


def curve(run: Path) -> list[dict[str, float]]:
    """The validated points of a run's `history.csv`."""
    with (run / "history.csv").open() as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    return [row for row in rows if row["val_loss"] == row["val_loss"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", metavar="NAME=RUN", help="a name and the folder of a run")
    parser.add_argument("--out", type=Path, required=True, help="the picture, SVG or PNG")
    options = parser.parse_args()

    matplotlib.rcParams.update({
        "svg.hashsalt": "curves", "text.color": TEXT,
        "axes.facecolor": CANVAS, "axes.edgecolor": CANVAS, "axes.labelcolor": QUIET_TEXT, "axes.titlelocation": "left",
        "axes.titleweight": "semibold", "grid.color": LINE, "xtick.color": QUIET_TEXT, "ytick.color": QUIET_TEXT,
        "legend.edgecolor": LINE,
    })
    figure, (loss, error) = plt.subplots(1, 2, figsize=(9.6, 3.8), layout="constrained")
    for n, text in enumerate(options.runs):
        name, folder = text.split("=", 1)
        points = curve(Path(folder))
        steps = [point["step"] for point in points]
        style = {"color": COLOURS[n % len(COLOURS)], "marker": MARKS[n % len(MARKS)], "markersize": 4, "label": name}
        loss.plot(steps, [point["val_loss"] for point in points], **style)
        error.plot(steps, [point["val_mae_r_deg"] for point in points], **style)
    loss.set(title="Held out: Chamfer loss", xlabel="steps", yscale="log")
    error.set(title="Held out: MAE(R), degrees", xlabel="steps", yscale="log")
    error.yaxis.set_major_formatter("{x:g}")
    error.yaxis.set_minor_formatter("{x:g}")
    for axes in (loss, error):
        axes.grid(axis="y", which="both")
        axes.set_axisbelow(True)
    error.legend()
    figure.savefig(options.out, metadata={"Date": None} if options.out.suffix == ".svg" else None)


if __name__ == "__main__":
    main()

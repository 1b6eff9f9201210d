"""A Hydra sweep from Python: α and the retina, every combination a run of its own, and one table of them all.

python examples/sweep.py FOLDER    # start it again after a crash and only what is missing is run
"""

import csv
import sys
from pathlib import Path

from torchfovea.cli import main

if len(sys.argv) != 2:
    sys.exit("python examples/sweep.py FOLDER: expected a folder for the runs")
folder = Path(sys.argv[1])
sizes = ["fidelity=geometric", "episodes=4", "saccades=6", "memory.cells=400", "sensor.receptive_fields=1000"]
swept = ["acquisition.alpha=0,2", "sensor=log_polar,uniform", "scene=cans", "picture=false"]
status = main(["search", "--multirun", *swept, *sizes, f"hydra.sweep.dir={folder / 'runs'}"])
status = status or main(["collect", f"dir={folder / 'runs'}", f"hydra.run.dir={folder / 'table'}"])
if status == 0:
    with (folder / "table" / "collect.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            print(row["acquisition.alpha"], row["sensor"], f"{float(row['gap_per_saccade']):.2f}")
sys.exit(status)

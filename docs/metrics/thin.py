"""Makes the small tables of this folder out of the metrics.csv of runs: python thin.py RUN TABLE

A row is the mean of the iterations of 400 000 control steps, with those at its end, and the sum of their seconds. An iteration
with an evaluation is the last of its row, so that evaluations stand at the steps they were made at.
"""

import csv
import sys
from pathlib import Path

MEANS = ["episode/goals", "episode/in_tolerance", "episode/drop_rate", "episode/rot_dist", "episode/length", "training/progress"]
MEANS += ["policy/std", "eval/goals", "eval/drop_rate", "eval/rot_dist"]
SUMS = ["time/collect_s", "time/update_s"]
STEPS = 400_000


def numbers(rows, column):
    return [float(row[column]) for row in rows if row.get(column) not in (None, "", "NaN")]


def main(run, table):
    rows = list(csv.DictReader(open(Path(run) / "metrics.csv")))
    # A fork begins later than at nothing.
    length = int(rows[1]["env_steps"]) - int(rows[0]["env_steps"]) if len(rows) > 1 else 0
    groups, begun = [[]], int(rows[0]["env_steps"]) - length
    for row in rows:
        groups[-1].append(row)
        if int(row["env_steps"]) - begun >= STEPS or row["eval/goals"]:
            groups.append([])
            begun = int(row["env_steps"])
    Path(table).parent.mkdir(parents=True, exist_ok=True)
    with open(table, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["env_steps", *MEANS, *SUMS])
        # What is left at the end is too little for a mean.
        for group in groups[:-1]:
            found = [numbers(group, column) for column in MEANS]
            means = [f"{sum(values) / len(values):.5g}" if values else "" for values in found]
            writer.writerow([group[-1]["env_steps"], *means, *(f"{sum(numbers(group, column)):.2f}" for column in SUMS)])


main(*sys.argv[1:])

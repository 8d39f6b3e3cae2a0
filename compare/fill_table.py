"""Prints the table of fill.sh: one row for planish and for each other method, measured by `planish evaluate --fill`."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any


def measured(planish: str, given: list[str]) -> dict[str, Any]:
    found = subprocess.run([planish, "evaluate", *given, "--json"], check=True, capture_output=True, text=True)
    result: dict[str, Any] = json.loads(found.stdout)
    return result


def percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f}"


def main() -> None:
    planish, work, given = sys.argv[1], Path(sys.argv[2]), sys.argv[3:]
    rows = [("planish", measured(planish, given))]
    for kind, name in (("measured", ""), ("of planish", " on planish's frames")):
        for folder in sorted((work / kind).iterdir()):
            rows.append((f"{folder.name}{name}", measured(planish, [*given, "--results", str(folder)])))
    holes = (("cut", "cut, away from steps"), ("cut_near_steps", "cut, within 3 px of a step"), ("own", "of the sensor"))
    for key, title in holes:
        print(f"\n| {title}: {rows[0][1][key]['pixels']} pixels | filled, % | RMS, mm | median, mm | wrong surface, % | off by over 3 sigma, % |")
        print("|---|--:|--:|--:|--:|--:|")
        for way, row in rows:
            of = row[key]
            print(f"| {way} | {percent(of['filled'])} | {of['rms_mm']:.1f} | {of['median_mm']:.1f} | {percent(of['wrong'])} | {percent(of['over_three'])} |")


main()

"""The table of accuracy.sh, from the reports in a folder. Errors are ratios to the raw frames."""

import json
import pathlib
import sys

folder = pathlib.Path(sys.argv[1])
columns = [
    "", "RMS, near", "middle", "far", "normals, near", "middle", "far", "facets, near", "middle", "far",
    "at 60-75°", "over 30°", "near steps", "floating", "90° edge", "sphere",
    "lost", "ms",
]
print("| " + " | ".join(columns) + " |")
print("|" + "---|" * len(columns))


def row(name, report, raw, ms):
    def ratio(a, b):
        return f"{a / b:.2f}"

    ranges = list(zip(report["ranges"], raw["ranges"]))
    cells = [name]
    cells += [ratio(r["rmse_mm"], b["rmse_mm"]) for r, b in ranges]
    cells += [f"{r['normal_mean_deg']:.1f}°" for r, _ in ranges]
    cells += [f"{r['facet_mean_deg']:.1f}°" for r, _ in ranges]
    cells += [f"{report['angles'][2]['facet_mean_deg']:.1f}°", f"{100 * report['speck_share']:.2f} %"]
    cells += [ratio(report["edge_mean_mm"], raw["edge_mean_mm"]), f"{100 * report['flying_share']:.2f} %"]
    cells += [f"{report['crease_deg']:.1f}°", f"{100 * report['sphere_radius_bias']:+.2f} %"]
    cells += [f"{100 * report['lost_share']:.2f} %", ms]
    print("| " + " | ".join(cells) + " |")


first = True
for file in sorted(folder.glob("*.ms"), key=lambda file: file.stat().st_mtime_ns):
    rows = json.loads(file.with_suffix(".json").read_text())
    raw, found = rows[0], rows[-1]
    if first:
        row("raw", raw, raw, "")
        first = False
    ms = file.read_text().strip()
    row(file.stem, found, raw, f"{found['frame_ms'] if ms == 'own' else float(ms):.1f}")

"""Prints the tables of accuracy.sh from the reports in a folder. Errors in the first table are ratios to the raw frames."""

import json
import pathlib
import sys

folder = pathlib.Path(sys.argv[1])
columns = [
    "", "RMS, near", "middle", "far", "normals, near", "middle", "far", "facets, near", "middle", "far",
    "at 60-75°", "over 30°", "near steps", "floating", "90° edge", "normals there", "sphere",
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
    cells += [f"{report['crease_deg']:.1f}°", f"{report['crease_normal_deg']:.1f}°", f"{100 * report['sphere_radius_bias']:+.2f} %"]
    cells += [f"{100 * report['lost_share']:.2f} %", ms]
    print("| " + " | ".join(cells) + " |")


def size(curve):
    """Returns the name of a surface with its radius; a board has no radius."""
    radius_m = curve["radius_m"]
    return curve["name"] + (f" {100 * radius_m:g} cm" if radius_m else "")


def curves_table(reports, range_m):
    """Prints the RMS in mm and the facets' error of every curved surface at a range."""
    def at_range(report):
        return {size(curve): curve for curve in report["curves"] if curve["range_m"] == range_m}

    shapes = list(at_range(reports[0][1]))
    print(f"\n| at {range_m:g} m: RMS, mm; facets | " + " | ".join(shapes) + " |")
    print("|" + "---|" * (len(shapes) + 1))
    for name, report in reports:
        found = at_range(report)
        cells = [f"{found[s]['rmse_mm']:.2f}; {found[s]['facet_mean_deg']:.1f}°" if s in found else "-" for s in shapes]
        print(f"| {name} | " + " | ".join(cells) + " |")


reports = []
for file in sorted(folder.glob("*.ms"), key=lambda file: file.stat().st_mtime_ns):
    rows = json.loads(file.with_suffix(".json").read_text())
    raw, found = rows[0], rows[-1]
    if not reports:
        row("raw", raw, raw, "")
        reports.append(("raw", raw))
    ms = file.read_text().strip()
    row(file.stem, found, raw, f"{found['frame_ms'] if ms == 'own' else float(ms):.1f}")
    reports.append((file.stem, found))
for range_m in sorted({curve["range_m"] for curve in reports[0][1]["curves"]}):
    curves_table(reports, range_m)

"""Analysis errors of the ensemble filters beside the published ones, as a table.

    python examples/benchmarks/filters.py [--experiments 5] [--seed 0] [--only L96]

Exit code 1 if any median is more than 15 % worse than published.
"""

from __future__ import annotations

import argparse
import sys
import time

from torchsph.assimilation.twins.benchmarks import benchmarks


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--experiments", type=int, default=None, help="repetitions (the median counts)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="part of a benchmark's name")
    options = parser.parse_args(arguments)
    heads = ("published", "median", "lowest", "highest", "spread", "s")
    print(f"{'benchmark':26}" + "".join(f" {head:>9}" for head in heads))
    worst = 0.0
    for case in benchmarks():
        if options.only not in case.name:
            continue
        start = time.perf_counter()
        result = case.run(experiments=options.experiments, seed=options.seed)
        seconds = time.perf_counter() - start
        low, high, spread = result.error.min(), result.error.max(), result.spread.median()
        print(
            f"{case.name:26} {case.expected:9.3f} {result.median:9.3f} {low:9.3f} {high:9.3f} {spread:9.3f}"
            f" {seconds:9.1f}" + ("  some diverged" if bool(result.diverged.any()) else ""),
            flush=True,
        )
        worst = max(worst, result.median / case.expected)
        for name, (_, expected) in case.sectors.items():
            median = result.sectors[name].median().item()
            print(f"  {name:24} {expected:9.3f} {median:9.3f}", flush=True)
            worst = max(worst, median / expected)
    return int(worst > 1.15)


if __name__ == "__main__":
    sys.exit(main())

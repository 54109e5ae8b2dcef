"""Two controllers on the same episodes, and whether their difference is more than chance.

    python examples/compare_two.py --a ik --b ik:standing --episodes 50

`ik:standing` is `ik` without its steps. Both evaluations are kept in the folder `--out`: the same command
again computes nothing, and `wbc-bench report --results OUT` makes tables, figures and a report of them.
"""

import argparse

import wbc_bench


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare two controllers on the same episodes.")
    parser.add_argument("--a", default="ik")
    parser.add_argument("--b", default="ik:standing")
    parser.add_argument("--protocol", default="ablation_v1")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", default="build/compare_two")
    options = parser.parse_args()

    found = []
    for controller in (options.a, options.b):
        results = wbc_bench.evaluate(
            controller,
            options.protocol,
            episodes=options.episodes,
            replicates=1,
            workers=options.workers,
            out=options.out,
        )
        success = results.success
        print(f"{controller}: success {success.point:.1%} ({success.low:.1%} to {success.high:.1%})")
        print(results.episodes["outcome"].value_counts().to_string(), end="\n\n")
        found.append(results)
    print(wbc_bench.compare(*found).markdown())


if __name__ == "__main__":  # worker processes import this file and must not start evaluations of their own
    main()

"""Evaluate 60 committed episodes of every controller and protocol again and compare them with the record.

Another processor rounds differently, and a robot on the verge of falling amplifies that; so not the bytes are
compared but, over episodes spread evenly over all replicates:
  - at least 90 % of the outcomes are equal, a fall and an illegal contact counting alike (weights changed by
    a millionth change up to 5 % of a learned policy's, and 10 % if those two are told apart);
  - where they are equal and the robot stood, the median change of the position error is below 5 mm.
"""

import os
import sys

import numpy as np
import pandas as pd
from joblib import Parallel, delayed

from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.evaluation.shard import evaluate_shard
from wbc_bench.registry import spec_of_replicate
from wbc_bench.results.analysis import collect, not_terminated
from wbc_bench.results.store import ResultStore

EPISODES = 60
EQUAL_OUTCOMES = 0.90
POSITION_CHANGE = 0.005  # [m]


def main() -> int:
    store = ResultStore(sys.argv[1])
    names = sorted({run.record.protocol for run in store.runs()})
    if not names:
        print(f"SKIPPED: no records under {store.root} yet")
        return 0
    labels, work, failures = [], [], 0
    for name in names:
        protocol, path = find_protocol(name)
        manifest, sha256 = read_manifest(protocol, manifest_path(path))
        row_of = {key: row for row, key in enumerate(zip(manifest.replicate, manifest.episode, strict=True))}
        for spec, method in collect(store.runs(name)).items():
            record = method.records[0]
            if (record.protocol_digest, record.manifest_sha256) != (protocol.digest, sha256):
                print(f"FAILED {name} {spec}: the records answer another protocol or manifest")
                failures += 1
                continue
            every = np.linspace(0, len(method.episodes) - 1, min(EPISODES, len(method.episodes))).astype(int)
            chosen = method.episodes.iloc[every].reset_index(drop=True)
            keys = zip(chosen["replicate"], chosen["episode"], strict=True)
            rows = manifest.take(np.array([row_of[key] for key in keys]))
            for replicate, part in chosen.groupby("replicate"):  # a learned method has a seed for each
                own = spec_of_replicate(spec, int(replicate))
                labels.append((name, spec, part))
                work.append(delayed(evaluate_shard)(own, protocol, rows.take(part.index.to_numpy())))
    pairs: dict[tuple[str, str], list[tuple[pd.DataFrame, pd.DataFrame]]] = {}
    for (name, spec, before), table in zip(labels, Parallel(os.cpu_count())(work), strict=True):
        pairs.setdefault((name, spec), []).append((before, table.to_pandas()))
    for (name, spec), parts in pairs.items():
        before, after = (pd.concat(tables, ignore_index=True) for tables in zip(*parts, strict=True))
        failures += not compare(name, spec, before, after)
    return 1 if failures else 0


def compare(name: str, spec: str, before: pd.DataFrame, after: pd.DataFrame) -> bool:
    """Print and judge one controller."""
    fell = {"illegal_contact": "fell"}
    equal = before["outcome"].replace(fell) == after["outcome"].replace(fell)
    change = (before["position_error"] - after["position_error"]).abs()[equal & not_terminated(before)]
    median = float(change.median()) if len(change) else 0.0  # [m] nobody stood: nothing to compare
    ok = equal.mean() >= EQUAL_OUTCOMES and median < POSITION_CHANGE
    print(
        f"{'ok    ' if ok else 'FAILED'} {name} {spec}: {int(equal.sum())}/{len(equal)} outcomes equal "
        f"(at least {EQUAL_OUTCOMES:.0%}), median |change of position error| {median * 1000:.3f} mm over "
        f"{len(change)} episodes (below {POSITION_CHANGE * 1000:g} mm)"
    )
    return bool(ok)


if __name__ == "__main__":
    sys.exit(main())

"""All experiments, or those that are named, one after the other: whole, or quick as in CI.

    python experiments/run.py --quick                # all of them, to see that they work
    python experiments/run.py particles corridor     # these two, whole
    python experiments/run.py --list

An experiment is a folder beside this file with a `run.py` that takes --quick, --seed and --out;
what it says is in OUT/<name>/log.txt, and what it leaves beside that.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent


def names() -> list[str]:
    return sorted(path.parent.name for path in HERE.glob("*/run.py"))


def run(name: str, out: Path, arguments: list[str]) -> dict[str, object]:
    """One experiment in a process of its own; it must leave its numbers as JSON."""
    out.mkdir(parents=True, exist_ok=True)
    begun = time.time()
    command = [sys.executable, str(HERE / name / "run.py"), "--out", str(out), *arguments]
    with (out / "log.txt").open("w") as log:
        code = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT).returncode
    numbers = out / f"{name}.json"
    said = (out / "log.txt").read_text(errors="replace").strip().splitlines()
    why = ""
    if code:
        why = f"exit code {code}: {said[-1] if said else 'it said nothing'}"
    elif not numbers.exists() or numbers.stat().st_mtime < begun - 1:
        why = f"it left no {numbers.name}"
    else:
        try:
            json.loads(numbers.read_text())
        except ValueError as error:
            why = f"{numbers.name} is no JSON: {error}"
    return {"passed": not why, "seconds": round(time.time() - begun, 1), "why": why}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", metavar="NAME", nargs="*", help="default: all")
    parser.add_argument("--quick", action="store_true", help="each in a minute or so")
    parser.add_argument("--seed", type=int, help="the first of the seeds of each")
    parser.add_argument("--out", type=Path, default=Path("runs/experiments"), help="their folders")
    parser.add_argument("--list", action="store_true", help="the names, and nothing else")
    args = parser.parse_args()
    known = names()
    if args.list:
        print("\n".join(known))
        return 0
    for unknown in set(args.names) - set(known):
        parser.error(f"there is no experiment '{unknown}'; there are {', '.join(known)}")
    arguments = ["--quick"] * args.quick
    arguments += [] if args.seed is None else ["--seed", str(args.seed)]
    results = {}
    for name in args.names or known:
        results[name] = run(name, args.out / name, arguments)
        r = results[name]
        verdict = "passed" if r["passed"] else f"FAILED, {r['why']}; {args.out / name / 'log.txt'}"
        print(f"{name:24s} {r['seconds']:7.1f} s  {verdict}", flush=True)
    (args.out / "experiments.json").write_text(json.dumps(results, indent=1) + "\n")
    failed = [name for name, r in results.items() if not r["passed"]]
    print(f"{len(results) - len(failed)} of {len(results)} passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

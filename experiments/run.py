"""All studies, or those that are named, one after the other: whole, or quick as in the tests.

    python experiments/run.py --quick                # all of them, to see that they work
    python experiments/run.py particles corridor     # these two, whole
    python experiments/run.py robustness             # all of one folder
    python experiments/run.py --list

A study is a script in a folder beside this file whose text names --quick; it takes --quick, --seed
and --out. Its name is the script's, or the folder's if the script is `run.py`. What it prints is in
OUT/<name>/log.txt, and what it writes stands beside that: <name>.json at least.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent


def studies() -> dict[str, Path]:
    """The script of each study, by its name."""
    scripts = [path for path in sorted(HERE.glob("*/*.py")) if "--quick" in path.read_text()]
    return {path.parent.name if path.stem == "run" else path.stem: path for path in scripts}


def chosen(names: list[str], known: dict[str, Path]) -> list[str]:
    """The studies of these names, all of a folder where it is named; KeyError if there is none."""
    found = {}
    for name in names:
        of_folder = [study for study, path in known.items() if path.parent.name == name]
        if not of_folder and name not in known:
            raise KeyError(name)
        found |= dict.fromkeys(of_folder or [name])
    return list(found)


def run(name: str, script: Path, out: Path, arguments: list[str]) -> dict[str, object]:
    """One study in a process of its own; it must leave its numbers as JSON."""
    out.mkdir(parents=True, exist_ok=True)
    begun = time.time()
    command = [sys.executable, str(script), "--out", str(out), *arguments]
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
    parser.add_argument("names", metavar="NAME", nargs="*", help="studies or folders; default: all")
    parser.add_argument("--quick", action="store_true", help="each in a minute or so")
    parser.add_argument("--seed", type=int, help="the first of the seeds of each")
    parser.add_argument("--out", type=Path, default=Path("runs/experiments"), help="their folders")
    parser.add_argument("--list", action="store_true", help="the names, and nothing else")
    args = parser.parse_args()
    known = studies()
    if args.list:
        print("\n".join(known))
        return 0
    try:
        names = chosen(args.names, known) if args.names else list(known)
    except KeyError as error:
        parser.error(f"there is no study '{error.args[0]}'; there are {', '.join(known)}")
    arguments = ["--quick"] * args.quick
    arguments += [] if args.seed is None else ["--seed", str(args.seed)]
    results = {}
    for name in names:
        results[name] = run(name, known[name], args.out / name, arguments)
        r = results[name]
        verdict = "passed" if r["passed"] else f"FAILED, {r['why']}; {args.out / name / 'log.txt'}"
        print(f"{name:24s} {r['seconds']:7.1f} s  {verdict}", flush=True)
    (args.out / "experiments.json").write_text(json.dumps(results, indent=1) + "\n")
    failed = [name for name, r in results.items() if not r["passed"]]
    print(f"{len(results) - len(failed)} of {len(results)} passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

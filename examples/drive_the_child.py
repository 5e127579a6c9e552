"""Use the backend from any program: start the child, send a line, read lines (docs/design/protocol.md); stdlib only.

python examples/drive_the_child.py --out people/7 --seed 7
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path


def main() -> None:
    """Generates one person and prints the path of their file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--checkpoint", type=Path)
    arguments = parser.parse_args()
    params = {"seed": arguments.seed, "steps": arguments.steps, "out_dir": str(arguments.out)}
    if arguments.checkpoint is not None:
        params["checkpoint"] = str(arguments.checkpoint)

    command = [sys.executable, "-m", "primdiffusion.serve"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8") as child:
        print(
            json.dumps({"jsonrpc": "2.0", "id": 1, "method": "generate", "params": params}),
            file=child.stdin,
            flush=True,
        )
        for line in child.stdout:
            message = json.loads(line)
            if message.get("method") == "progress":
                print("{stage} {step}/{total}".format(**message["params"]))
            elif message.get("id") == 1:
                break
        child.stdin.close()  # ends the child
    if "error" in message:
        sys.exit(message["error"]["message"])
    print(message["result"]["person"])


if __name__ == "__main__":
    main()

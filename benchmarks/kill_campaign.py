"""Kill a real recording again and again, let it finish, and see whether anything is lost, torn or doubled.

python benchmarks/kill_campaign.py --kills=30 --folder=outputs/kills
"""

import argparse
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

from tqdm import trange

from lerobot_dataset_maniskill.integrity import whole_dataset
from lerobot_wmrl.data.recorded_episodes import recorded_episodes


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=30, help="how often to kill the command")
    parser.add_argument("--episodes", type=int, default=400, help="to record in all")
    parser.add_argument("--longest", type=float, default=60.0, help="seconds until a kill, at most")
    parser.add_argument("--folder", type=Path, default=Path("outputs/kills"), help="a new folder")
    given = parser.parse_args()
    given.folder.mkdir(parents=True)
    root, rng = given.folder / "dataset", random.Random(0)
    flags = [f"--num_episodes={given.episodes}", "--part_episodes=4", "--num_workers=2"]
    command = [sys.executable, "-m", "lerobot_dataset_maniskill.record", *flags, f"--output_dir={root}"]
    for _ in trange(given.kills, desc="Killing", unit="kill"):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(rng.uniform(5.0, given.longest))
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run(command, check=True)
    problem = whole_dataset(root, given.episodes)
    seeds = sorted(recorded_episodes(root)["seed"].tolist())
    print(f"{given.kills} kills: {problem or 'the dataset is whole'};", end=" ")
    print("every episode once" if seeds == list(range(given.episodes)) else f"episodes differ: {seeds}")


if __name__ == "__main__":
    main()

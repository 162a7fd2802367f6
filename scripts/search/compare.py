"""Search and simplification beside VAMP's: `compare.py OURS... -- VAMPS...`, what `--example search` and vamp.cc have printed, several sequences of
samples each. A row per class: parts solved of what both take as valid, medians in µs of search, simplification and their sum with their ratios, the
ratio of the mean sums, and the ratio of the mean lengths. Only problems that both solve count for times and lengths: of each the median over all
sequences in which it was solved.
"""

import statistics
import sys
from collections import defaultdict


def read(files):
    """By class and index: for each sequence None where it was not solved, else search, simplification, length. Invalid problems are missing."""
    problems = defaultdict(list)
    for file in files:
        with open(file, encoding="utf-8") as lines:
            for words in filter(lambda words: len(words) > 2, map(str.split, lines)):
                if words[2] != "invalid":
                    found = (float(words[3]), float(words[4]), float(words[7])) if words[2] == "solved" else None
                    problems[words[0], words[1]].append(found)
    return problems


def medians(sequences):
    solved = [found for found in sequences if found]
    if not solved:
        return None
    search, simplification, length = (statistics.median(values) for values in zip(*solved))
    return search, simplification, statistics.median(f[0] + f[1] for f in solved), length


def main():
    split = sys.argv.index("--")
    ours, vamps = read(sys.argv[1:split]), read(sys.argv[split + 1 :])
    valid = [key for key in ours if key in vamps]
    for name in sorted({key[0] for key in valid}) + ["all"]:
        keys = [key for key in valid if name in (key[0], "all")]
        parts = [sum(f is not None for k in keys for f in of[k]) / sum(len(of[k]) for k in keys) for of in (ours, vamps)]
        pairs = [(medians(ours[key]), medians(vamps[key])) for key in keys]
        pairs = [(a, b) for a, b in pairs if a and b]
        columns = []
        for i in range(3):
            a, b = (statistics.median(pair[side][i] for pair in pairs) for side in (0, 1))
            columns.append(f"{a:.0f} {b:.0f} {a / b:.2f}")
        mean = [sum(a[i] for a, _ in pairs) / sum(b[i] for _, b in pairs) for i in (2, 3)]
        print(f"{name} | {len(keys)} | {parts[0]:.1%} {parts[1]:.1%} | {' | '.join(columns)} | {mean[0]:.2f} | {mean[1]:.3f}")


main()

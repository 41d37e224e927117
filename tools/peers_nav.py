"""pynmea2 on the sentences of standard input: peers_nav.py COUNT ROUNDS prints best and median sentences per second, and how many are decoded."""

import sys
import time

import pynmea2

count, rounds = int(sys.argv[1]), int(sys.argv[2])
sentences = [line.strip() for line in sys.stdin if line.strip()]
repeats = max(1, count // len(sentences))


def understood(sentence):
    try:
        message = pynmea2.parse(sentence, check=True)
    except pynmea2.ParseError:
        return False
    # A proprietary sentence of an unknown manufacturer is returned undecoded.
    return type(message) is not pynmea2.ProprietarySentence


rates = []
for _ in range(rounds):
    start = time.perf_counter()
    for _ in range(repeats):
        for sentence in sentences:
            try:
                pynmea2.parse(sentence, check=True)
            except pynmea2.ParseError:
                pass
    rates.append(repeats * len(sentences) / (time.perf_counter() - start))
rates.sort()
print(rates[-1], rates[len(rates) // 2], sum(map(understood, sentences)))

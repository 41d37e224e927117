"""Counts what a log holds, without Echotank: python3 count.py FILE... prints one line per file."""

import collections
import re
import struct
import sys


def text_pieces(data):
    """Lines, from the first sentence on, with the recorder's stamp as a tuple that sorts."""
    for line in data.split(b"\n"):
        start = re.search(rb"[$!]", line)
        if not start:
            continue
        stamp = re.match(rb"(?:(\d{4}-\d\d-\d\d)[T ])?(\d\d):(\d\d):(\d\d)[.,]?(\d*)", line)
        when = None
        if stamp:
            day, h, m, s, fraction = stamp.groups()
            when = (day or b"", int(h), int(m), int(s), int((fraction + b"0" * 9)[:9]))
        yield when, line[start.start() :].rstrip(b"\r")


def pcap_pieces(data):
    """UDP payloads of a little-endian microsecond Ethernet capture, split at line ends."""
    at = 24
    while at + 16 <= len(data):
        seconds, micros, length = struct.unpack("<III", data[at : at + 12])
        udp = data[at + 16 + 34 : at + 16 + length]
        payload = udp[8 : struct.unpack(">H", udp[4:6])[0]]
        at += 16 + length
        for line in re.split(rb"[\r\n]+", payload):
            if line:
                yield (seconds, micros), line


def count_text(pieces):
    stamped = backward = sentences = bad = missing = 0
    before = None
    names = collections.Counter()
    for when, text in pieces:
        if when is not None:
            stamped += 1
            backward += before is not None and when < before
            before = when
        parts = [part for part in re.split(rb"(?=[$!])", text) if part]
        for i, part in enumerate(parts):
            body, star, tail = part[1:].partition(b"*")
            if not star and (i + 1 < len(parts) or not body):
                continue  # torn by the start of the next one
            sentences += 1
            names[body.split(b",")[0].decode()] += 1
            total = 0
            for byte in body:
                total ^= byte
            hexa = re.match(rb"[0-9A-Fa-f]{2}", tail)
            if not star or not re.match(rb"[0-9A-Fa-f]", tail):
                missing += 1
            elif not hexa or int(hexa.group(), 16) != total:
                bad += 1
    return stamped, backward, sentences, bad, missing, names


def count_tlog(data):
    names = collections.Counter()
    at = 0
    while at < len(data):
        frame = data[at + 8 :]
        if frame[0] == 0xFD:
            number = frame[7] | frame[8] << 8 | frame[9] << 16
            at += 8 + 12 + frame[1] + 13 * (frame[2] & 1)
        else:
            number = frame[5]
            at += 8 + 8 + frame[1]
        names[number] += 1
    return names


for path in sys.argv[1:]:
    data = open(path, "rb").read()
    if path.endswith(".tlog"):
        names = count_tlog(data)
        print(path, "messages", sum(names.values()), sorted(names.items()))
        continue
    pieces = pcap_pieces(data) if data[:4] == b"\xd4\xc3\xb2\xa1" else text_pieces(data)
    stamped, backward, sentences, bad, missing, names = count_text(pieces)
    print(path, "stamped", stamped, "backward", backward, "sentences", sentences, "bad", bad, "missing", missing, sorted(names.items()))

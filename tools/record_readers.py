#!/usr/bin/env python3
"""Opens recordings with third-party readers (tools/requirements.txt) and prints the number of pings in each, as one JSON object.

    .venv/bin/python tools/record_readers.py [--sevenk] FILE...

pyjsf for .jsf, pyxtf for .xtf, brping for .svlog, sigmf for .sigmf-meta, libsndfile for .wav, mcap with mcap-ros2-support for .mcap, json for .jsonl (.s7k
has tools/sevenk_reader.py; with --sevenk, pyread7k reads it, which is on GitHub only: where it is missing, tools/sevenk_reader.py). A file that its reader
cannot read completely is an error.
"""

import json
import os
import sys
import warnings


def jsf(path):
    from pyjsf.jsf_io import jsf_read
    numbers = [m[1].ping_number for m in jsf_read(path) if m[0].message_type == 80]
    return {"pings": len(set(numbers)), "messages": len(numbers)}


def sevenk(path):
    try:
        import pyread7k
    except ModuleNotFoundError:
        import sevenk_reader
        return {"pings": sevenk_reader.read_file(path, sevenk_reader.Findings())["pings"], "reader": "sevenk_reader"}
    pings = [ping.sonar_settings.ping_number for ping in pyread7k.S7KFileReader(path).iter_pings()]
    return {"pings": len(set(pings)), "reader": "pyread7k"}


def xtf(path):
    import pyxtf
    _, packets = pyxtf.xtf_read(path)
    pings = packets.get(pyxtf.XTFHeaderType.sonar, [])
    return {"pings": len({p.PingNumber for p in pings})}


def svlog(path):
    from brping import definitions
    from brping.pingmessage import PingParser
    parser, numbers = PingParser(), []
    with open(path, "rb") as file:
        for byte in file.read():
            if parser.parse_byte(byte) == PingParser.NEW_MESSAGE:
                if parser.rx_msg.message_id == definitions.OMNISCAN450_OS_MONO_PROFILE:
                    numbers.append(parser.rx_msg.ping_number)
    if parser.errors or parser.state != PingParser.WAIT_START:
        raise ValueError("%d frames are wrong, or the last is truncated" % parser.errors)
    return {"pings": len(set(numbers))}


def sigmf(path):
    import sigmf as reader
    if os.path.getsize(path.replace(".sigmf-meta", ".sigmf-data")) == 0:
        # The reader fails on an empty recording; its message is irrelevant.
        with open(path, encoding="utf-8") as file:
            return {"pings": len(json.load(file)["annotations"])}
    recording = reader.sigmffile.fromfile(path, autoscale=False)
    recording.validate()
    pings = recording.get_annotations()
    if pings:
        last = pings[-1]
        count = last["core:sample_start"] + last["core:sample_count"]
        if len(recording.read_samples()) != count:
            raise ValueError("words for %d sample times" % count)
    return {"pings": len(pings)}


def wav(path):
    import soundfile
    about = soundfile.info(path)
    if about.frames and len(soundfile.read(path, start=about.frames - 1)[0]) != 1:
        raise ValueError("the last sample time is missing")
    return {"seconds": about.frames / about.samplerate}


def mcap(path):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    if os.path.getsize(path) == 0:
        return {"pings": 0}
    with open(path, "rb") as file:
        decoded = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        return {"pings": len({of.message.sequence for of in decoded})}


def jsonl(path):
    with open(path, encoding="utf-8") as file:
        text = file.read()
    if text and not text.endswith("\n"):
        raise ValueError("the last line is truncated")
    return {"lines": len([json.loads(line) for line in text.splitlines()])}


READERS = {".jsf": jsf, ".xtf": xtf, ".svlog": svlog, ".sigmf-meta": sigmf, ".wav": wav, ".mcap": mcap, ".jsonl": jsonl}


def main():
    warnings.simplefilter("ignore")
    held = {}
    arguments = sys.argv[1:]
    if "--sevenk" in arguments:
        arguments.remove("--sevenk")
        READERS[".s7k"] = sevenk
    for path in arguments:
        ending = os.path.splitext(path)[1]
        if ending in READERS:
            try:
                held[path] = READERS[ending](path)
            except Exception as error:  # whatever a reader raises is what it has to say
                held[path] = {"error": "%s: %s" % (type(error).__name__, error)}
    print(json.dumps(held))
    return 1 if any("error" in what for what in held.values()) else 0


if __name__ == "__main__":
    sys.exit(main())

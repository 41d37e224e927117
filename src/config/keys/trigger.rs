//! The keys of `[sonar.trigger]` and `[sonar.trigger_out]`.

use super::*;

table! {
    /// The source of pings. The arrival of a trigger (over UDP: at the kernel) is time zero of the ping. With run.clock = "lockstep" an external
    /// trigger is a step. echotank replay ignores triggers and uses sonar.ping.
    Trigger;

    /// "internal": the rate in sonar.ping. "udp": every datagram (those that begin with $PETKT, as sent by trigger_out, once per number). "tcp":
    /// every line of any client. "serial-cts", "serial-dcd": an edge of that line. "protocol": pings that a topside requests by number. "sonar":
    /// every pulse of another sonar. The ping rate applies to "internal" only; a topside may switch to it.
    source: Choice("internal", "udp", "tcp", "serial-cts", "serial-dcd", "protocol", "sonar"), Default("\"internal\"");

    /// Address and port. Only with source = "udp" or "tcp".
    listen: Text, Optional("\"127.0.0.1:10125\""), needed with source = "udp" or "tcp";

    /// Only with source = "serial-cts" or "serial-dcd".
    port: Text, Optional("\"/dev/ttyUSB0\""), needed with source = "serial-cts" or "serial-dcd";

    /// Only with source = "serial-cts" or "serial-dcd".
    edge: Choice("rising", "falling"), Default("\"rising\""), only with source = "serial-cts" or "serial-dcd";

    /// The sonar whose pulses trigger this one. Only with source = "sonar".
    follow: Name, Optional("\"main\""), needed with source = "sonar";

    /// Delay after the other sonar's pulse. 0: simultaneous pings. Only with source = "sonar".
    delay_ms: Ms(from(0.0, 60_000.0)), Default("0.0"), only with source = "sonar";

    /// A trigger during the listening window of the previous ping. "refuse": it is refused and counted. "queue": the first one waits until the
    /// window ends, and the others are refused. Only with a source other than "internal".
    early: Choice("refuse", "queue"), Default("\"refuse\"");

    /// A trigger that follows the last pulse within this time is early too. Only with a source other than "internal".
    min_interval_ms: Ms(from(0.0, 60_000.0)), Default("0.0");

    /// A missing trigger is counted after this time without one. Only with a source other than "internal".
    watchdog_ms: Ms(above(0.0, 3.6e6)), Optional("2000.0");
}

table! {
    /// Signals every pulse at its time.
    TriggerOut;

    /// Address and port of a datagram: $PETKT,NUMBER,SECONDS,SONAR*SUM with the UTC of the pulse in seconds since 1970, nine decimals, and an
    /// NMEA 0183 checksum.
    to: Text, Optional("\"127.0.0.1:10126\"");

    /// A serial port whose line is raised at the pulse.
    port: Text, Optional("\"/dev/ttyUSB0\"");

    /// Only with port.
    line: Choice("rts", "dtr"), Default("\"rts\""), only with port;

    /// Time for which the line stays raised. Only with port.
    pulse_ms: Ms(from(0.1, 1000.0)), Default("1.0"), only with port;
}

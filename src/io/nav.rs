//! Navigation inputs: recorded logs, CSV tracks, UDP and serial ports.

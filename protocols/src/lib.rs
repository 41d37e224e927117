//! Sonar wire formats, sans I/O.

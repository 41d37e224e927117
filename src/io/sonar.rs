//! Servers for the sonar protocols.

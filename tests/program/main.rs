//! The program as its user runs it: its commands, the daemon, the replay.

mod commands;
mod daemon;
mod replay;

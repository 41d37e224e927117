//! Echotank: a hardware-in-the-loop sonar emulator.

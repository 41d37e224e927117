//! Recorders: `.s7k`, `.npz`, `.png` and the truth file.

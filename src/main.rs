//! The program: its command line.

// Documentation comments of arguments are help texts, with [tables] of the configuration in brackets.
#![allow(rustdoc::broken_intra_doc_links)]

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}

//! `echotank generate`: manual pages and shell completions, from the declaration of the command line.

use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::path::PathBuf;

use clap::{Args, Command, Subcommand};
use clap_complete::Shell;

use super::Failure;

/// Sections of the main page that the declaration of the command line does not hold.
const MORE_SECTIONS: &str = r#".SH "EXIT STATUS"
.TP
0
Success.
.TP
1
A failure while running, or a check that has findings.
.TP
2
A wrong configuration or wrong arguments.
.SH ENVIRONMENT
.TP
RUST_LOG
Levels of diagnostics, for example \fBinfo\fR or \fBechotank_runtime=debug\fR.
.TP
ECHOTANK_TOKEN
Token of \fBechotank ctl\fR for a daemon on another computer.
.SH FILES
Of the Debian package:
.TP
.I /etc/echotank/rig.toml
Configuration of the service \fBechotank.service\fR.
.TP
.I /usr/share/echotank
Example configurations and their data.
.TP
.I /var/lib/echotank
Home of the user \fBechotank\fR, and working folder of the service.
"#;

#[derive(Args, Debug)]
pub(crate) struct GenerateArgs {
    #[command(subcommand)]
    product: Product,
}

#[derive(Subcommand, Debug)]
enum Product {
    /// Write manual pages, one for each command
    Man {
        /// Folder for the pages; made if it does not exist
        folder: PathBuf,
    },
    /// Print the completion script of a shell
    Completions {
        /// Shell
        shell: Shell,
    },
}

/// Generates from `command`, the whole command line.
pub(crate) fn main(args: &GenerateArgs, mut command: Command) -> Result<(), Failure> {
    match &args.product {
        Product::Man { folder } => fs::create_dir_all(folder)
            .and_then(|()| clap_mangen::generate_to(command, folder))
            .and_then(|()| {
                OpenOptions::new()
                    .append(true)
                    .open(folder.join("echotank.1"))
            })
            .and_then(|mut page| page.write_all(MORE_SECTIONS.as_bytes()))
            .map_err(|error| Failure::Running(format!("{}: {error}", folder.display()))),
        Product::Completions { shell } => {
            clap_complete::generate(*shell, &mut command, "echotank", &mut io::stdout());
            Ok(())
        }
    }
}

//! Refusals of command lines: clap's messages, with "did you mean" for short words and without the wording of Rust's parsers.

use clap::CommandFactory;
use clap::error::{ContextKind, ContextValue, ErrorKind};

use super::Cli;
use echotank_config::did_you_mean;

/// Messages of the standard library's parsers, and what they mean.
const PARSERS: [(&str, &str); 8] = [
    ("invalid digit found in string", "must be a whole number"),
    (
        "cannot parse integer from empty string",
        "must be a whole number",
    ),
    ("number too large to fit in target type", "is too large"),
    ("number too small to fit in target type", "is too small"),
    ("invalid float literal", "must be a number"),
    ("cannot parse float from empty string", "must be a number"),
    (
        "invalid socket address syntax",
        "must be an address and a port, such as 127.0.0.1:7780",
    ),
    (
        "provided string was not `true` or `false`",
        "must be true or false",
    ),
];

/// Prints a refusal, a help text or the version, and exits.
pub(super) fn exit(mut error: clap::Error) -> ! {
    suggest(&mut error);
    let text = error.render().to_string();
    let own = PARSERS.iter().fold(text.clone(), |text, (theirs, own)| {
        text.replace(theirs, own)
    });
    if own == text {
        error.exit();
    }
    eprint!("{own}");
    std::process::exit(2);
}

/// Adds the most similar value or subcommand where clap finds none.
fn suggest(error: &mut clap::Error) {
    let text = |kind| match error.get(kind) {
        Some(ContextValue::String(text)) => Some(text.clone()),
        _ => None,
    };
    match error.kind() {
        ErrorKind::InvalidValue if error.get(ContextKind::SuggestedValue).is_none() => {
            let (Some(given), Some(ContextValue::Strings(known))) = (
                text(ContextKind::InvalidValue),
                error.get(ContextKind::ValidValue),
            ) else {
                return;
            };
            if let Some(best) = nearest(&given, known.iter().map(String::as_str)) {
                error.insert(ContextKind::SuggestedValue, ContextValue::String(best));
            }
        }
        ErrorKind::InvalidSubcommand if error.get(ContextKind::SuggestedSubcommand).is_none() => {
            let Some(given) = text(ContextKind::InvalidSubcommand) else {
                return;
            };
            // The subcommand that was given before, such as `ctl`, has subcommands of its own.
            let cli = Cli::command();
            let mut level = &cli;
            for word in std::env::args().skip(1).take_while(|word| *word != given) {
                level = level.find_subcommand(&word).unwrap_or(level);
            }
            let known = level.get_subcommands().map(clap::Command::get_name);
            if let Some(best) = nearest(&given, known) {
                let value = ContextValue::Strings(vec![best]);
                error.insert(ContextKind::SuggestedSubcommand, value);
            }
        }
        _ => {}
    }
}

fn nearest<'a>(given: &str, known: impl Iterator<Item = &'a str>) -> Option<String> {
    let hint = did_you_mean(given, known)?;
    hint.split('"').nth(1).map(str::to_owned)
}

//! Errors of methods, of method selection and of whole pings against references. Each question has one subcommand.

pub(crate) mod atlas;
pub(crate) mod case;
pub(crate) mod errors;
pub(crate) mod rigs;
pub(crate) mod soundings;
mod survey;
pub(crate) mod sweep;

use clap::Subcommand;

#[derive(Subcommand)]
#[command(
    about = "Measure errors of methods, of their selection and of whole pings, against references"
)]
pub(crate) enum Question {
    Atlas(atlas::Arguments),
    Errors(errors::Arguments),
    Rigs(rigs::Arguments),
    Soundings(soundings::Arguments),
    Survey(survey::Arguments),
    Sweep(sweep::Arguments),
}

pub(crate) fn run(question: Question) -> Result<(), Box<dyn std::error::Error>> {
    match question {
        Question::Atlas(given) => atlas::run(given),
        Question::Errors(given) => errors::run(given),
        Question::Rigs(given) => rigs::run(given),
        Question::Soundings(given) => soundings::run(given),
        Question::Survey(given) => survey::run(given),
        Question::Sweep(given) => sweep::run(given),
    }
}

//! The command line of UPCR: parse, call, print. The binary `upcr` is [`run`]; whoever embeds it has the same.

#[cfg(feature = "train")]
mod adapt;
#[cfg(feature = "train")]
mod calibrate;
mod convert;
mod eval;
mod features;
#[cfg(feature = "train")]
mod import;
mod info;
mod input;
mod merge;
mod output;
mod pairs;
mod register;
#[cfg(feature = "train")]
mod reproduce;
mod stream;
mod synth;
#[cfg(feature = "train")]
mod train;
mod view;

use std::ffi::OsString;

use clap::{Parser, Subcommand};

pub use input::short_names;
pub use merge::scans_in;
pub use pairs::Pairs;

/// How a command ended, as the exit status tells it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Status {
    /// All was done.
    Done = 0,
    /// A file, a cloud or a setting is not usable.
    Failed = 1,
    /// The command line is not understood.
    NotUnderstood = 2,
    /// `register` found no pose to trust; `merge` left scans out.
    NotRegistered = 3,
    /// Stopped before the end, as shells have it after Ctrl-C.
    Stopped = 130,
}

fn after_help() -> String {
    format!(
        "\
Exit status:
  0  done
  1  error: a file, a cloud or a setting is not usable; the reason is on stderr
  2  the command line is not understood
  3  `register` found no trustworthy pose (probability below {})
  130  `train` or `reproduce` was stopped and can go on

The answer alone goes to stdout; errors and progress go to stderr.",
        upcr::TRUSTWORTHY
    )
}

/// Rigid registration of point clouds
#[derive(Parser)]
#[command(name = "upcr", version, after_help = after_help())]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Register(register::Args),
    Merge(merge::Args),
    View(view::Args),
    Features(features::Args),
    Synth(synth::Args),
    Convert(convert::Args),
    Info(info::Args),
    #[cfg(feature = "train")]
    Train(train::Args),
    #[cfg(feature = "train")]
    Adapt(adapt::Args),
    #[cfg(feature = "train")]
    Calibrate(calibrate::Args),
    Eval(eval::Args),
    #[cfg(feature = "train")]
    Reproduce(reproduce::Args),
    #[cfg(feature = "train")]
    Import(import::Args),
}

/// Runs the command that `args` tell, the first being the program's name. Its answer goes to stdout, all else to stderr.
pub fn run(args: impl IntoIterator<Item = impl Into<OsString> + Clone>) -> Status {
    let cli = match Cli::try_parse_from(args) {
        Ok(cli) => cli,
        Err(error) => {
            // Help and the version are told the same way; a reader that hangs up ends nothing.
            let _ = error.print();
            return if error.use_stderr() { Status::NotUnderstood } else { Status::Done };
        }
    };
    let outcome = match cli.command {
        Command::Register(args) => register::run(&args),
        Command::Merge(args) => merge::run(&args),
        Command::View(args) => view::run(&args),
        Command::Features(args) => features::run(&args),
        Command::Synth(args) => synth::run(&args),
        Command::Convert(args) => convert::run(&args),
        Command::Info(args) => info::run(&args),
        #[cfg(feature = "train")]
        Command::Train(args) => train::run(&args),
        #[cfg(feature = "train")]
        Command::Adapt(args) => adapt::run(&args),
        #[cfg(feature = "train")]
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Eval(args) => eval::run(&args),
        #[cfg(feature = "train")]
        Command::Reproduce(args) => reproduce::run(&args),
        #[cfg(feature = "train")]
        Command::Import(args) => import::run(&args),
    };
    outcome.unwrap_or_else(|error| {
        output::note(&format!("error: {}", describe(&error)));
        Status::Failed
    })
}

/// The chain of causes in one line, down to the library's own error, which already tells its cause.
fn describe(error: &anyhow::Error) -> String {
    let mut parts = Vec::new();
    for cause in error.chain() {
        parts.push(cause.to_string());
        if cause.is::<upcr::Error>() {
            break;
        }
    }
    parts.join(": ")
}

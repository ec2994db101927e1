//! The command line of UPCR: parse, call, print.

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
mod output;
mod pairs;
mod register;
#[cfg(feature = "train")]
mod reproduce;
mod synth;
#[cfg(feature = "train")]
mod train;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// `register` ran, but found no pose to trust.
const NOT_REGISTERED: u8 = 3;
/// Stopped before the end, as shells have it after Ctrl-C.
#[cfg(feature = "train")]
const STOPPED: u8 = 130;

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

fn main() -> ExitCode {
    let outcome = match Cli::parse().command {
        Command::Register(args) => register::run(&args),
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
        ExitCode::FAILURE
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

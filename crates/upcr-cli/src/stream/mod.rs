//! `--rerun`: clouds, poses and figures to a Rerun viewer, or into a file that one opens.

#[cfg(not(feature = "rerun"))]
mod absent;
mod alignment;
mod registration;
#[cfg(feature = "rerun")]
mod viewer;

use std::ffi::OsStr;
#[cfg(feature = "rerun")]
use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::builder::TypedValueParser;
use clap::error::ErrorKind;
use clap::{Arg, Command};

#[cfg(not(feature = "rerun"))]
pub use absent::Stream;
pub use alignment::Alignment;
pub use registration::Shown;
#[cfg(feature = "rerun")]
pub use viewer::Stream;

/// The option of streaming, shared by the commands.
#[derive(clap::Args)]
pub struct Streaming {
    /// Stream to a Rerun viewer (rerun.io): to the one that runs here, or else to one that is started; or to WHERE: a
    /// viewer's address, `rerun+http://HOST:PORT/proxy`, or a file to write, `NAME.rrd`
    #[arg(
        long,
        value_name = "WHERE",
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = "",
        value_parser = WhereParser,
        hide = cfg!(not(feature = "rerun"))
    )]
    rerun: Option<Where>,
}

impl Streaming {
    /// Begins the stream, where one is asked for. `name` tells recordings apart in the viewer, which shows `layout` at first.
    ///
    /// # Errors
    /// Where no viewer answers, or the file cannot come to its place.
    #[cfg(feature = "rerun")]
    pub fn open(&self, name: &str, layout: &Layout) -> Result<Option<Stream>> {
        use anyhow::Context;
        self.rerun.as_ref().map(|to| Stream::open(to, name, layout)).transpose().context("--rerun")
    }

    #[cfg(not(feature = "rerun"))]
    #[allow(clippy::unnecessary_wraps)]
    pub fn open(&self, _: &str, _: &Layout) -> Result<Option<Stream>> {
        Ok(self.rerun.map(|nowhere| match nowhere {}))
    }
}

/// What of a stream is shown side by side.
#[cfg_attr(not(feature = "rerun"), allow(dead_code))]
pub struct Layout {
    pub clouds: bool,
    /// Names that curves begin with, a diagram each.
    pub curves: &'static [&'static str],
    /// Whether words come with it, as documents or lines of the log.
    pub words: bool,
}

/// Where a stream goes.
#[cfg(feature = "rerun")]
#[derive(Clone)]
enum Where {
    /// The viewer on this machine.
    Here,
    /// A viewer's address.
    Address(re_sdk::external::re_uri::ProxyUri),
    File(PathBuf),
}

#[cfg(not(feature = "rerun"))]
#[derive(Clone, Copy)]
enum Where {}

#[derive(Clone)]
struct WhereParser;

impl TypedValueParser for WhereParser {
    type Value = Where;

    fn parse_ref(&self, command: &Command, _: Option<&Arg>, value: &OsStr) -> Result<Where, clap::Error> {
        Where::parse(value).map_err(|reason| {
            let words = format!("--rerun: {reason}\n");
            clap::Error::raw(ErrorKind::InvalidValue, words).with_cmd(command)
        })
    }
}

impl Where {
    #[cfg(feature = "rerun")]
    fn parse(value: &OsStr) -> Result<Self, String> {
        if value.is_empty() {
            return Ok(Self::Here);
        }
        if Path::new(value).extension().is_some_and(|extension| extension == "rrd") {
            return Ok(Self::File(value.into()));
        }
        match value.to_str().filter(|text| text.contains("://")) {
            Some(address) => {
                address.parse().map(Self::Address).map_err(|error| format!("{address}: {error}"))
            }
            None => Err(format!(
                "{}: neither a viewer's address, rerun+http://HOST:PORT/proxy, nor a file's name that ends in .rrd",
                value.display()
            )),
        }
    }

    #[cfg(not(feature = "rerun"))]
    fn parse(_: &OsStr) -> Result<Self, String> {
        Err("this program is built without the feature `rerun`; to have it: \
             cargo install --path crates/upcr-cli --features rerun"
            .into())
    }
}

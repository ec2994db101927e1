//! Which threads a call runs on.

use std::num::NonZeroUsize;

use crate::{Error, Result};

/// Runs `work` inside a pool of `threads` threads, or of those that the current pool has.
///
/// From inside a pool every parallel step starts without waking a thread first.
pub(crate) fn on_threads<T: Send>(
    threads: Option<NonZeroUsize>,
    work: impl FnOnce() -> T + Send,
) -> Result<T> {
    match threads {
        Some(threads) if threads.get() != rayon::current_num_threads() => {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.get()).build();
            let refused = |e: rayon::ThreadPoolBuildError| Error::InvalidSetting {
                name: "threads",
                reason: e.to_string(),
            };
            Ok(pool.map_err(refused)?.install(work))
        }
        _ => Ok(rayon::scope(|_| work())),
    }
}

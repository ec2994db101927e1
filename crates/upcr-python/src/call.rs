//! Calls that take long: without the interpreter's lock, on other threads, ended by Ctrl-C.

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::process;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::errors::setting;

/// Time between two looks at whether Python has signals to handle.
const TICK: Duration = Duration::from_millis(10);

/// Whoever waits for a call's end: may lose interest, and hears events.
pub struct Caller<E> {
    gone: Arc<AtomicBool>,
    tell: Box<dyn Fn(E) + Send + Sync>,
}

enum Message<T, E> {
    Event(E),
    Done(thread::Result<T>),
}

impl<E> Caller<E> {
    /// Whether nobody waits for the result any more.
    pub fn is_gone(&self) -> bool {
        self.gone.load(Ordering::Relaxed)
    }

    /// Tells an event, which Python hears soon; the call does not wait.
    pub fn tell(&self, event: E) {
        (self.tell)(event);
    }
}

/// Where work is done.
pub enum Place {
    /// Among the threads that all calls share.
    Pool(&'static ThreadPool),
    /// On a thread of its own: for work that mostly waits for others'.
    Thread,
}

/// Does `work` elsewhere, while this thread lets other Python threads run, hands events to `hear`, and looks for signals.
///
/// Where a signal's handler or `hear` raises, its exception is returned at once; `work` is told that nobody waits and
/// is left to end by itself, which is why it owns what it works on.
pub fn run<T: Send + 'static, E: Send + 'static>(
    py: Python<'_>,
    place: Place,
    work: impl FnOnce(&Caller<E>) -> T + Send + 'static,
    mut hear: impl FnMut(E) -> PyResult<()>,
) -> PyResult<T> {
    let gone = Arc::new(AtomicBool::new(false));
    let (messages, mut heard) = channel();
    let events = messages.clone();
    // Who is gone hears nothing.
    let tell = Box::new(move |event| drop(events.send(Message::Event(event))));
    let caller = Caller { gone: gone.clone(), tell };
    let work = move || {
        // A panic goes on where the call came from.
        let done = catch_unwind(AssertUnwindSafe(|| work(&caller)));
        drop(messages.send(Message::Done(done)));
    };
    match place {
        Place::Pool(pool) => pool.spawn(work),
        Place::Thread => drop(thread::Builder::new().name("upcr".into()).spawn(work)?),
    }
    loop {
        // Moved into the closure, as a receiver is for one thread at a time.
        let heard = &mut heard;
        let next = match py.detach(move || heard.recv_timeout(TICK)) {
            Ok(Message::Event(event)) => hear(event),
            Ok(Message::Done(Ok(done))) => return Ok(done),
            Ok(Message::Done(Err(panic))) => resume_unwind(panic),
            Err(RecvTimeoutError::Timeout) => Ok(()),
            Err(RecvTimeoutError::Disconnected) => {
                Err(PyRuntimeError::new_err("the work ended without a result"))
            }
        };
        if let Err(error) = next.and_then(|()| py.check_signals()) {
            gone.store(true, Ordering::Relaxed);
            return Err(error);
        }
    }
}

/// As [`run`] among the shared threads, for work that tells nothing on its way.
pub fn run_silent<T: Send + 'static>(
    py: Python<'_>,
    work: impl FnOnce() -> T + Send + 'static,
) -> PyResult<T> {
    run(py, Place::Pool(pool(py)?), move |_: &Caller<()>| work(), |()| Ok(()))
}

/// The process's pool with the number of the process: threads do not survive a fork.
static POOL: Mutex<Option<(u32, &'static ThreadPool)>> = Mutex::new(None);

/// The threads that all calls share which are not told how many to use.
pub fn pool(_: Python<'_>) -> PyResult<&'static ThreadPool> {
    // Whoever locks is attached to the interpreter, as whoever forks is: a child never finds it locked.
    let mut pool = POOL.lock().unwrap_or_else(PoisonError::into_inner);
    match *pool {
        Some((owner, pool)) if owner == process::id() => Ok(pool),
        _ => {
            // As many as there are processors; one such pool a process.
            let new = &*Box::leak(Box::new(own_pool(0)?));
            *pool = Some((process::id(), new));
            Ok(new)
        }
    }
}

/// A pool of so many threads; 0: as many as there are processors.
pub fn own_pool(threads: usize) -> PyResult<ThreadPool> {
    ThreadPoolBuilder::new().num_threads(threads).build().map_err(|error| setting("threads", error))
}

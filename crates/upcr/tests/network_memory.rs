//! A network that has seen a pair needs no more memory for the next.
#![allow(missing_docs, clippy::unwrap_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use upcr::net::Network;

/// The system's allocator, which counts what it is asked for.
struct Counting;

static ASKED: AtomicUsize = AtomicUsize::new(0);

// SAFETY: all is left to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ASKED.fetch_add(1, Ordering::Relaxed);
        // SAFETY: as the caller's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: as the caller's.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn a_warm_network_allocates_nothing() {
    let network = Network::embedded().unwrap();
    let cloud = |seed: f32| -> Vec<[f32; 3]> {
        (0..500)
            .map(|i| i as f32 * 0.37 + seed)
            .map(|t| [t.sin(), 0.6 * (1.7 * t).cos(), 0.4 * (2.9 * t).sin()])
            .collect()
    };
    let (source, target) = (cloud(0.0), cloud(1.0));
    // One thread: on several, it is chance how many rooms are in use at a time.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let asked = pool.install(|| {
        for _ in 0..3 {
            network.predict(&source, &target).unwrap();
        }
        let before = ASKED.load(Ordering::Relaxed);
        network.predict(&source, &target).unwrap();
        ASKED.load(Ordering::Relaxed) - before
    });
    assert_eq!(asked, 0);
}

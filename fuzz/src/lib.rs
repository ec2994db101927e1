//! What every target does with its bytes. The library's tests include this module too, and replay the corpus with it.

#[path = "../../crates/upcr/tests/common/consistent.rs"]
pub mod consistent;
pub mod read;
pub mod register;

/// Hands `data` to the target of that name; fails on whatever must not be.
pub fn run(target: &str, data: &[u8]) {
    match target {
        "register" => register::register(data),
        reader => read::read(reader, data),
    }
}

/// To be called first by a target whose reader catches the panics of the crate that decompresses for it: the fuzzer stops
/// at every panic otherwise. All other panics still stop it.
pub fn allow_panics_that_are_caught() {
    let stop = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        if !panic.location().is_some_and(|at| at.file().contains("/laz-")) {
            stop(panic);
        }
    }));
}

#![no_main]

libfuzzer_sys::fuzz_target!(init: upcr_fuzz::allow_panics_that_are_caught(), |data: &[u8]| upcr_fuzz::run("laz", data));

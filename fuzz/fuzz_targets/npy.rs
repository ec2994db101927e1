#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| upcr_fuzz::run("npy", data));

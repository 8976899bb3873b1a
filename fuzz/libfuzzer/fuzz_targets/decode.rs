//! See `uadp_fuzz::decode`.
#![no_main]

libfuzzer_sys::fuzz_target!(|datagram: &[u8]| uadp_fuzz::decode(datagram));

//! Data sets, a virtual scanner, training and evaluation around the `upcr` library.

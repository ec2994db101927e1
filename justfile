# List the recipes
default:
    @just --list

# Build everything, optimised
build:
    cargo build --workspace --release

# Register the sample scans
sample:
    cargo run --release -p upcr-cli -- register samples/source.ply samples/target.ply

# Run all tests; those on public scans say `skipped` where the data is absent
test:
    cargo test --workspace

# Format the code
fmt:
    cargo fmt

# Check layout and lints
lint:
    cargo fmt --check
    cargo clippy --workspace --all-targets -- -D warnings

# Build the documentation, warnings being errors
docs:
    RUSTDOCFLAGS='-D warnings' cargo doc --no-deps --workspace

# Run the benchmarks
bench *args:
    cargo bench --workspace {{ args }}

# Measure accuracy on public scans, e.g. `just evaluate --sets bunny`
evaluate *args:
    cargo build --release -p upcr-cli
    python3 bench/evaluate.py {{ args }}

# All that continuous integration checks
ci:
    .ci/run

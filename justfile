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

# Build the Python wheel and test it in a fresh environment
python *args:
    crates/upcr-python/test {{ args }}

# Build the guide into target/guide, and for its reference the Python package
guide:
    python3 -m venv target/guide-venv
    target/guide-venv/bin/pip install --quiet --requirement docs/guide/requirements.txt ./crates/upcr-python
    target/guide-venv/bin/python -m sphinx --fail-on-warning --quiet -c docs/guide docs target/guide

# Build the viewer that reports hold
viewer:
    cd web && npm ci --ignore-scripts && npm run build

# Build the page that registers in the browser into target/web/index.html
page:
    rustup target add wasm32-unknown-unknown
    cd web && npm ci --ignore-scripts && npm run page

# Check the viewer, and in a browser the reports and the page that registers
web:
    cargo build --release -p upcr-cli
    web/test

# Check what streams to Rerun, which nothing else builds
rerun:
    cargo clippy -p upcr-cli --all-targets --features rerun --profile quick --locked -- -D warnings
    cargo test -p upcr-cli --features rerun --profile quick --locked rerun

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

# Run the benchmarks of neighbours, normals and features
bench *args:
    cargo bench --workspace {{ args }}

# Measure accuracy on public scans, e.g. `just evaluate --sets bunny`; needs bench/requirements.txt
evaluate *args:
    cargo build --release -p upcr-cli
    python3 bench/evaluate.py {{ args }}

# Measure speed and accuracy beside Open3D and small_gicp; needs bench/requirements.txt
compare *args:
    cargo build --release -p upcr-cli
    python3 bench/peers.py {{ args }}

# Fuzz every reader and the registration for so many seconds in all
fuzz seconds="3600":
    #!/usr/bin/env bash
    targets=$(ls fuzz/fuzz_targets | wc -l)
    beside=$(( $(nproc) < targets ? $(nproc) : targets ))
    fuzz/run "$(( {{ seconds }} * beside / targets + 1 ))"

# Register so many degenerate pairs
degenerate count="50000":
    UPCR_DEGENERATE={{ count }} cargo test -p upcr --test degenerate_inputs -- --nocapture

# All that continuous integration checks
ci:
    .ci/run

//! `upcr-web-bindgen MODULE.wasm FOLDER`: writes the module and the JavaScript that calls it.

use std::error::Error;

use wasm_bindgen_cli_support::Bindgen;

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [module, folder] = &args[..] else { return Err("a module and a folder are needed".into()) };
    Ok(Bindgen::new().input_path(module).web(true)?.typescript(true).generate(folder)?)
}

//! The library as WebAssembly, with the weights inside: two scans' bytes in, all that a page shows out. `web/app` in the
//! repository is that page; its worker calls what is here.

mod outcome;

use js_sys::{Array, Function, Uint8Array};
use upcr::Progress;
use wasm_bindgen::prelude::*;

pub use outcome::{Choices, File, Outcome};

#[wasm_bindgen(start)]
fn start() {
    // A fault of ours ends the module, and has to be told before.
    std::panic::set_hook(Box::new(|info| wasm_bindgen::throw_str(&info.to_string())));
}

/// The version of the library.
#[wasm_bindgen]
pub fn version() -> String {
    env!("CARGO_PKG_VERSION").into()
}

/// The extensions that can be read, without the dot.
#[wasm_bindgen]
pub fn extensions() -> Vec<String> {
    upcr::io::extensions().map(|(extension, _)| extension.into()).collect()
}

/// Two scans, and how one lies on the other.
#[wasm_bindgen]
#[derive(Debug)]
pub struct Registered(Outcome);

/// Reads two files and registers them. `choices` are [`Choices`] as JSON; `progress` hears the step under way and the share
/// that is done, 0 to 1.
///
/// # Errors
/// What is wrong with a file or a choice, in words.
#[wasm_bindgen]
pub fn register(
    source_name: &str,
    source: &[u8],
    target_name: &str,
    target: &[u8],
    choices: &str,
    progress: &Function,
) -> Result<Registered, JsError> {
    let choices: Choices = serde_json::from_str(choices)?;
    let progress = OnlyThread(progress);
    let hear = |told: Progress| progress.tell(told);
    let source = File { name: source_name, bytes: source };
    let target = File { name: target_name, bytes: target };
    Ok(Registered(Outcome::new(source, target, &choices, &hear)?))
}

/// A function of JavaScript's, which stays on its thread, and here there is no other.
struct OnlyThread<'a>(&'a Function);

// SAFETY: the module is built without threads.
#[cfg(not(target_feature = "atomics"))]
unsafe impl Sync for OnlyThread<'_> {}

impl OnlyThread<'_> {
    fn tell(&self, told: Progress) {
        // What the page does with it is not ours to mend.
        let _ = self.0.call2(&JsValue::NULL, &told.stage.to_string().into(), &told.done.into());
    }
}

#[wasm_bindgen]
impl Registered {
    /// What the page tells, as JSON, and after it names and bytes by turns.
    ///
    /// # Errors
    /// Where there is nothing to show.
    pub fn contents(&self) -> Result<Array, JsError> {
        let contents = self.0.contents()?;
        let all = Array::of1(&contents.words.into());
        for (name, bytes) in contents.blobs {
            all.push(&name.into());
            all.push(&Uint8Array::from(&bytes[..]).into());
        }
        Ok(all)
    }

    /// The report, one HTML page.
    ///
    /// # Errors
    /// Where there is nothing to show.
    pub fn report(&self) -> Result<String, JsError> {
        Ok(self.0.report()?)
    }

    /// The source moved onto the target by pose 0, the one found, or by an alternative, as a file whose format `name` tells.
    ///
    /// # Errors
    /// Where the format cannot hold it.
    pub fn aligned(&self, pose: usize, name: &str) -> Result<Vec<u8>, JsError> {
        Ok(self.0.aligned(pose, name)?)
    }
}

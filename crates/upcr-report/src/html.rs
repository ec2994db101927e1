//! HTML that carries words as JSON, points as base64, and the one script that may run.

use std::fmt::Write;

use base64::{Engine, engine::general_purpose::STANDARD};
use serde::Serialize;

const SCRIPT: &str = include_str!("../assets/viewer.js");
const SCRIPT_SHA256: &str = include_str!("../assets/viewer.sha256");

/// What a page is about.
#[derive(Debug, Clone)]
pub struct Contents {
    /// What is to be told, as JSON in which no character means something to HTML.
    pub words: String,
    /// What is to be drawn: points, colours and distances, each with its name.
    pub blobs: Vec<(String, Vec<u8>)>,
}

/// The page that holds what its script reads.
pub(crate) fn assemble(Contents { words, blobs }: &Contents) -> String {
    let size: usize = blobs.iter().map(|(_, bytes)| 4 * bytes.len().div_ceil(3) + 64).sum();
    let mut html = String::with_capacity(SCRIPT.len() + size + (1 << 16));
    // No other script runs, and nothing is fetched: not from elsewhere, and not from where the page came from.
    let _ = write!(
        html,
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; script-src 'sha256-{SCRIPT_SHA256}'; \
         base-uri 'none'; form-action 'none'\">\n<title>UPCR</title>\n</head>\n<body>\n\
         <noscript>The clouds are drawn by the page's own script, and scripts are turned off here.</noscript>\n\
         <script type=\"application/json\" id=\"page\">{words}</script>\n"
    );
    for (id, bytes) in blobs {
        let _ = write!(html, "<script type=\"text/plain\" id=\"{id}\">");
        STANDARD.encode_string(bytes, &mut html);
        html.push_str("</script>\n");
    }
    let _ = write!(html, "<script>{SCRIPT}</script>\n</body>\n</html>\n");
    html
}

/// JSON without a character that means something to HTML, or ends a line of a script.
pub(crate) fn json(value: &impl Serialize) -> String {
    // Numbers, text and lists always become JSON.
    let plain = serde_json::to_string(value).unwrap_or_default();
    let mut text = String::with_capacity(plain.len());
    for c in plain.chars() {
        match c {
            '<' | '>' | '&' | '\u{2028}' | '\u{2029}' => {
                let _ = write!(text, "\\u{:04x}", u32::from(c));
            }
            _ => text.push(c),
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_script_but_the_one_inside_may_run_and_nothing_is_fetched() {
        let html = assemble(&Contents { words: json(&"a"), blobs: Vec::new() });
        assert!(html.contains("default-src 'none'; script-src 'sha256-"));
        assert!(!SCRIPT.contains("</script") && !SCRIPT.contains("<!--") && !SCRIPT.contains('\r'));
        assert_eq!(SCRIPT_SHA256.len(), 44);
    }
}

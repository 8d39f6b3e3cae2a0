//! The block of results in a document.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use planish::io::write_whole;

use super::record::Origin;
use super::section::Section;

/// A document with a block of results to replace.
pub struct Document {
    path: PathBuf,
    /// The markers in the first and the last line of the block.
    marks: [String; 2],
    /// Path from the document to the folder with the pictures.
    folder: String,
}

impl Document {
    /// Opens a document and checks that it has the block, before any measurement that could be lost.
    pub fn open(path: &Path, folder: &Path) -> Result<Self> {
        let absolute = |path: &Path| std::path::absolute(path).with_context(|| path.display().to_string());
        let (whole_path, whole_folder) = (absolute(path)?, absolute(folder)?);
        let below = whole_path.parent().and_then(|parent| whole_folder.strip_prefix(parent).ok());
        let (Some(below), Some(name)) = (below, folder.file_name()) else {
            bail!(
                "--out {}: must be inside the folder of {}, which shows its pictures",
                folder.display(),
                path.display()
            );
        };
        // Links have slashes on every system, and no spaces.
        let parts = below.components().map(|part| part.as_os_str().to_string_lossy().replace(' ', "%20") + "/");
        let name = name.to_string_lossy();
        let marks = [format!("<!-- planish bench {name} -->"), format!("<!-- end of planish bench {name} -->")];
        let document = Self { path: path.to_owned(), marks, folder: parts.collect() };
        document.around()?;
        Ok(document)
    }

    /// Returns the text before and after the block, each with the block's marker.
    fn around(&self) -> Result<[String; 2]> {
        let text = fs::read_to_string(&self.path).with_context(|| self.path.display().to_string())?;
        let [start, end] = &self.marks;
        let places = |mark: &str| text.match_indices(mark).map(|(at, _)| at).collect::<Vec<_>>();
        match (&places(start)[..], &places(end)[..]) {
            (&[from], &[to]) if from < to => {
                let from = from + start.len();
                Ok([text[..from].to_owned(), text[to..].to_owned()])
            }
            _ => {
                bail!("{}: must contain these lines exactly once, in this order:\n{start}\n{end}", self.path.display())
            }
        }
    }

    /// Reads the document again and writes it with a new block.
    pub fn update(&self, origin: &Origin, sections: &[Section]) -> Result<()> {
        let [mut text, after] = self.around()?;
        write!(text, "\n\n{}", origin.markdown())?;
        for section in sections {
            // Within the block, the sections are below the heading of their machine.
            write!(text, "\n{}", section.markdown(&self.folder).replacen("## ", "### ", 1))?;
        }
        write!(text, "\n{after}")?;
        write_whole(&self.path, text.as_bytes()).with_context(|| self.path.display().to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_is_replaced_and_the_rest_stays() {
        let folder = tempfile::tempdir().unwrap();
        let (file, out) = (folder.path().join("B.md"), folder.path().join("docs/one"));
        let marked =
            |inside: &str| format!("a\n<!-- planish bench one -->\n{inside}<!-- end of planish bench one -->\nz\n");
        fs::write(&file, marked("old\n")).unwrap();
        let mut section = Section::new("speedup", "Speedup");
        section.svg("plot.svg", "a plot", String::new());
        for _ in 0..2 {
            Document::open(&file, &out)
                .unwrap()
                .update(&Origin::here(&crate::Options::default()), std::slice::from_ref(&section))
                .unwrap();
        }
        let text = fs::read_to_string(&file).unwrap();
        assert!(text.starts_with("a\n<!-- planish bench one -->\n\n`planish"), "{text}");
        assert!(text.ends_with("\n<!-- end of planish bench one -->\nz\n") && !text.contains("old"), "{text}");
        assert_eq!(text.matches("\n### Speedup\n").count(), 1);
        assert!(text.contains("![a plot](docs/one/plot.svg)"), "{text}");
    }

    #[test]
    fn a_document_without_the_block_is_refused_with_what_it_lacks() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("B.md");
        fs::write(&file, "<!-- end of planish bench one -->\n<!-- planish bench one -->\n").unwrap();
        let error = Document::open(&file, &folder.path().join("docs/one")).err().unwrap().to_string();
        assert!(error.contains("B.md") && error.contains("<!-- planish bench one -->"), "{error}");
        // A document with the block twice is refused as well.
        let block = "<!-- planish bench one -->\r\n<!-- end of planish bench one -->\r\n";
        fs::write(&file, block.repeat(2)).unwrap();
        assert!(Document::open(&file, &folder.path().join("one")).is_err());
        fs::write(&file, block).unwrap();
        assert!(Document::open(&file, &folder.path().join("one")).is_ok());
        for elsewhere in [folder.path(), Path::new("/"), Path::new("one")] {
            let error = Document::open(&file, elsewhere).err().map(|error| error.to_string());
            assert!(error.is_some_and(|error| !error.is_empty()), "{}", elsewhere.display());
        }
    }
}

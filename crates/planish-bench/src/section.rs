//! The report of an experiment: text with tables, JSON, plots and pictures.

use std::path::Path;

use anyhow::{Context, Result};
use planish::Error;
use planish::io::internal::create_output_folder;
use planish::io::write_rgb_png;
use planish::io::{RgbImage, write_whole};
use serde_json::{Value, json};

use super::record::Origin;

/// One experiment's results.
pub struct Section {
    /// Name of the section's files without extension.
    pub name: &'static str,
    text: String,
    pub json: Value,
    pub figures: Vec<Figure>,
}

pub struct Figure {
    /// Name of the figure's file.
    pub file: String,
    pub title: String,
    pub content: Drawing,
}

pub enum Drawing {
    Svg(String),
    Png(RgbImage),
}

impl Section {
    pub fn new(name: &'static str, title: &str) -> Self {
        Self { name, text: format!("## {title}\n"), json: Value::Null, figures: Vec::new() }
    }

    /// Adds a table with a header and one line per entry of `rows`.
    pub fn table(&mut self, header: &[&str], rows: impl IntoIterator<Item = Vec<String>>) {
        let line = |cells: &mut dyn Iterator<Item = String>| {
            format!("| {} |\n", cells.map(|cell| cell.replace('|', "\\|")).collect::<Vec<_>>().join(" | "))
        };
        self.text += "\n";
        self.text += &line(&mut header.iter().map(|cell| (*cell).to_owned()));
        self.text += &line(&mut header.iter().map(|_| "---".to_owned()));
        for row in rows {
            self.text += &line(&mut row.into_iter());
        }
    }

    /// Adds a paragraph.
    pub fn note(&mut self, text: impl AsRef<str>) {
        self.text += "\n";
        self.text += text.as_ref();
        self.text += "\n";
    }

    /// Notes the number of noisy measurements, if any.
    pub fn note_noise(&mut self, timings: impl IntoIterator<Item = bool>) {
        let (all, noisy) = timings.into_iter().fold((0, 0), |(all, noisy), is| (all + 1, noisy + usize::from(is)));
        if noisy > 0 {
            self.note(format!("The machine was not quiet: {noisy} of {all} times varied too much (marked ~)."));
        }
    }

    pub fn svg(&mut self, file: &str, title: &str, svg: String) {
        self.figures.push(Figure { file: file.to_owned(), title: title.to_owned(), content: Drawing::Svg(svg) });
    }

    /// Returns the text and the pictures as Markdown. `folder` is the path from the document to the pictures; it ends
    /// in a slash or is empty.
    pub fn markdown(&self, folder: &str) -> String {
        let figures = self.figures.iter().map(|figure| format!("\n![{}]({folder}{})\n", figure.title, figure.file));
        self.text.clone() + &figures.collect::<String>()
    }

    pub fn print(&self) {
        crate::outln!("{}", self.text);
    }

    /// Notes the skipped measurements and the reasons.
    pub fn note_skipped(&mut self, skipped: Vec<String>) {
        skipped.into_iter().for_each(|what| self.note(format!("Not measured: {what}.")));
    }

    /// Writes the section into a folder, including the origin of the numbers.
    pub fn write(&self, folder: &Path, origin: &Origin) -> Result<()> {
        create_output_folder(folder).with_context(|| format!("cannot create the folder {}", folder.display()))?;
        let write = |name: &str, bytes: &[u8]| {
            let file = folder.join(name);
            write_whole(&file, bytes).with_context(|| file.display().to_string())
        };
        write(&format!("{}.md", self.name), self.markdown("").as_bytes())?;
        let json = json!({ "origin": origin, "results": self.json });
        write(&format!("{}.json", self.name), serde_json::to_string_pretty(&json)?.as_bytes())?;
        for figure in &self.figures {
            match &figure.content {
                Drawing::Svg(svg) => write(&figure.file, svg.as_bytes())?,
                Drawing::Png(image) => write_rgb_png(&folder.join(&figure.file), image).map_err(Error::from)?,
            }
        }
        Ok(())
    }
}

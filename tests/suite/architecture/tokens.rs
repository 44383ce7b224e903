//! The size of files and functions in tokens. Unlike a number of lines, it stays the same however much is packed into a line.

use std::fs;
use std::path::Path;

use syn::spanned::Spanned;
use syn::visit::{self, Visit};

use super::imports::is_of_tests;
use super::{sources, src};

/// The most tokens of a file and of a function.
const FILE: usize = 3500;
const FUNCTION: usize = 500;

/// The files with more tokens. The list only shrinks.
const LONGER_FILES: &[&str] = &[];

/// The functions with more tokens. The list only shrinks.
const LONGER_FUNCTIONS: &[&str] = &[];

/// The statements that set several variables from values written side by side. The number only shrinks.
const SEVERAL_AT_ONCE: usize = 7;

/// Counts a line's words, strings and marks. An empty line and a comment have none.
fn tokens(line: &str) -> usize {
    let mut rest = line.trim();
    let mut count = 0;
    if rest.starts_with("//") {
        return count;
    }
    while let Some(first) = rest.chars().next() {
        let length = match first {
            '"' => string(rest).unwrap_or(1),
            _ if is_of_word(first) => rest.find(|c| !is_of_word(c)).unwrap_or(rest.len()),
            _ => first.len_utf8(),
        };
        count += usize::from(!first.is_whitespace());
        rest = &rest[length..];
    }
    count
}

fn is_of_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// The length of the string at the beginning of `text`, if it ends there.
fn string(text: &str) -> Option<usize> {
    let mut chars = text.char_indices().skip(1);
    loop {
        match chars.next()? {
            (end, '"') => return Some(end + 1),
            (_, '\\') => drop(chars.next()?),
            _ => {}
        }
    }
}

/// What a file holds beside its tests.
#[derive(Default)]
struct Contents {
    /// The name, first and last line of each function. Lines begin at 1.
    functions: Vec<(String, usize, usize)>,
    /// The lines of statements that set several variables from values written side by side.
    several_at_once: Vec<usize>,
}

impl Contents {
    fn add(&mut self, signature: &syn::Signature, block: &syn::Block) {
        let first = signature.span().start().line;
        self.functions
            .push((signature.ident.to_string(), first, block.span().end().line));
    }
}

impl<'ast> Visit<'ast> for Contents {
    fn visit_item(&mut self, item: &'ast syn::Item) {
        if !is_of_tests(item) {
            visit::visit_item(self, item);
        }
    }

    fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
        self.add(&item.sig, &item.block);
        visit::visit_item_fn(self, item);
    }

    fn visit_trait_item_fn(&mut self, item: &'ast syn::TraitItemFn) {
        if let Some(block) = &item.default {
            self.add(&item.sig, block);
        }
        visit::visit_trait_item_fn(self, item);
    }

    fn visit_impl_item_fn(&mut self, item: &'ast syn::ImplItemFn) {
        self.add(&item.sig, &item.block);
        visit::visit_impl_item_fn(self, item);
    }

    fn visit_local(&mut self, local: &'ast syn::Local) {
        let value = local.init.as_ref().map(|init| &*init.expr);
        let is_of_several = match value {
            Some(syn::Expr::Tuple(_)) => matches!(local.pat, syn::Pat::Tuple(_)),
            Some(syn::Expr::Array(_)) => matches!(local.pat, syn::Pat::Slice(_)),
            _ => false,
        };
        if is_of_several {
            self.several_at_once.push(local.span().start().line);
        }
        visit::visit_local(self, local);
    }

    fn visit_expr_assign(&mut self, set: &'ast syn::ExprAssign) {
        let is_of_several = match *set.right {
            syn::Expr::Tuple(_) => matches!(*set.left, syn::Expr::Tuple(_)),
            syn::Expr::Array(_) => matches!(*set.left, syn::Expr::Array(_)),
            _ => false,
        };
        if is_of_several {
            self.several_at_once.push(set.span().start().line);
        }
        visit::visit_expr_assign(self, set);
    }
}

/// The path within src/, the text and the contents of each file.
fn files() -> Vec<(String, String, Contents)> {
    let read = |path: &Path| {
        let text = fs::read_to_string(path).unwrap();
        let mut contents = Contents::default();
        contents.visit_file(&syn::parse_file(&text).unwrap());
        (
            path.strip_prefix(src())
                .unwrap()
                .to_str()
                .unwrap()
                .to_owned(),
            text,
            contents,
        )
    };
    sources(&src()).iter().map(|path| read(path)).collect()
}

#[test]
fn a_token_is_a_word_a_string_or_a_mark() {
    assert_eq!(tokens(r#"    let x_1 = f("a \" b", 'c'); // γ = 2"#), 17);
    assert_eq!(tokens(r#"" of the line before""#), 1);
    assert_eq!(tokens(r#"begins here: "and goes on"#), 7);
    assert_eq!(tokens("  /// A comment."), 0);
}

#[test]
fn files_are_short() {
    for (file, text, _) in files() {
        let size = text
            .lines()
            .take_while(|line| !line.trim().starts_with("#[cfg(test)]"))
            .map(tokens)
            .sum::<usize>();
        let is_exempt = LONGER_FILES.contains(&file.as_str());
        assert!(
            size <= FILE || is_exempt,
            "{file} has {size} tokens, more than {FILE}"
        );
        assert!(
            size > FILE || !is_exempt,
            "{file} is short enough: LONGER_FILES must not name it"
        );
    }
}

#[test]
fn tests_are_at_the_end_of_a_file() {
    for (file, text, _) in files() {
        let items = syn::parse_file(&text).unwrap().items;
        let after = items
            .iter()
            .skip_while(|item| !is_of_tests(item))
            .find(|item| !is_of_tests(item));
        assert!(
            after.is_none(),
            "{file}: there is more than tests after the first `#[cfg(test)]`"
        );
    }
}

#[test]
fn functions_are_short() {
    let mut longer = Vec::new();
    let mut counted = 0;
    for (file, text, contents) in files() {
        let lines: Vec<&str> = text.lines().collect();
        for (name, first, last) in contents.functions {
            let size: usize = lines[first - 1..last].iter().map(|line| tokens(line)).sum();
            counted += 1;
            if size > FUNCTION {
                longer.push(format!("{file}: {name}"));
            }
        }
    }
    assert!(counted > 500, "most functions were not found");
    let new: Vec<&String> = longer
        .iter()
        .filter(|function| !LONGER_FUNCTIONS.contains(&function.as_str()))
        .collect();
    assert!(
        new.is_empty(),
        "these have more than {FUNCTION} tokens: {new:#?}"
    );
    let is_short = |function: &&&str| !longer.iter().any(|longer| longer == **function);
    let short: Vec<&&str> = LONGER_FUNCTIONS.iter().filter(is_short).collect();
    assert!(
        short.is_empty(),
        "these are short enough, so LONGER_FUNCTIONS must not name them: {short:#?}"
    );
}

#[test]
fn a_statement_sets_one_variable() {
    let places: Vec<String> = files()
        .iter()
        .flat_map(|(file, _, contents)| {
            contents
                .several_at_once
                .iter()
                .map(move |line| format!("{file}:{line}"))
        })
        .collect();
    let count = places.len();
    assert!(
        count <= SEVERAL_AT_ONCE,
        "{count} statements set several variables: {places:#?}"
    );
}

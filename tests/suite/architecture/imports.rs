//! Finds out from the code which file of a crate uses which others. Code that exists for tests only is left out.
//!
//! Follows `use`, re-exports and written paths to the file that defines a name. Naming a module alone does not count as using it.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use syn::punctuated::Punctuated;
use syn::visit::{self, Visit};

/// The path of a module from the root of the crate, empty for the root.
type Module = Vec<String>;

/// The files that each file uses.
pub(super) type Imports = BTreeMap<PathBuf, BTreeSet<PathBuf>>;

/// The imports of a crate with this name, as paths within its folder `src`.
pub(super) fn imports(src: &Path, name: &'static str) -> Imports {
    let mut house = House {
        name,
        modules: BTreeMap::new(),
    };
    let mut paths: Vec<(PathBuf, Module, Vec<String>)> = Vec::new();
    for path in super::sources(src) {
        let file = path.strip_prefix(src).unwrap().to_owned();
        let module = module_of(&file);
        let parsed = syn::parse_file(&fs::read_to_string(&path).unwrap()).unwrap();
        house.add(&file, &module, &parsed.items, &mut paths);
    }
    let mut found = Imports::new();
    for (file, module, path) in paths {
        let used = found.entry(file.clone()).or_default();
        used.extend(
            house
                .file_of(&module, &path, 0)
                .filter(|other| *other != file),
        );
    }
    found
}

/// The imports between the files of a Python package. They are written `from .file import name` or `from . import file`.
pub(super) fn of_python(package: &Path) -> Imports {
    let mut found = Imports::new();
    for path in super::sources(package)
        .iter()
        .filter(|path| path.extension().is_some_and(|ending| ending == "py"))
    {
        let file = path.strip_prefix(package).unwrap();
        let text = fs::read_to_string(path).unwrap();
        let used = found.entry(file.to_owned()).or_default();
        for line in text
            .lines()
            .filter_map(|line| line.trim().strip_prefix("from ."))
        {
            let (place, names) = line.split_once(" import ").unwrap();
            let places = if place.is_empty() {
                names.split(", ").collect()
            } else {
                vec![place]
            };
            for place in places
                .into_iter()
                .filter(|place| !package.join(format!("{place}.pyi")).exists())
            {
                let other = PathBuf::from(format!("{place}.py"));
                let is_file = package.join(&other).exists();
                used.insert(if is_file { other } else { "__init__.py".into() });
            }
        }
        used.retain(|other| other != file);
    }
    found
}

/// The module of a file: a::b for `a/b.rs` and `a/b/mod.rs`.
fn module_of(file: &Path) -> Module {
    let mut names: Module = file
        .with_extension("")
        .iter()
        .map(|part| part.to_str().unwrap().to_owned())
        .collect();
    let last = names.pop().unwrap();
    match last.as_str() {
        "mod" | "lib" => {}
        // It is another crate, which refers to this one by name.
        "main" => names.push("main".into()),
        _ => names.push(last),
    }
    names
}

/// The names in a module.
#[derive(Default)]
struct Names {
    file: PathBuf,
    defined: BTreeSet<String>,
    /// The paths of imported names, by their local name.
    imported: BTreeMap<String, Vec<String>>,
    globs: Vec<Vec<String>>,
}

/// All modules of a crate.
struct House {
    name: &'static str,
    modules: BTreeMap<Module, Names>,
}

impl House {
    /// Adds the items of a module, and to `paths` every path that is written in it.
    fn add(
        &mut self,
        file: &Path,
        module: &[String],
        items: &[syn::Item],
        paths: &mut Vec<(PathBuf, Module, Vec<String>)>,
    ) {
        let mut names = Names {
            file: file.to_owned(),
            ..Names::default()
        };
        let mut written = Written::default();
        for item in items.iter().filter(|item| !is_of_tests(item)) {
            match item {
                syn::Item::Mod(syn::ItemMod {
                    ident,
                    content: Some((_, inner)),
                    ..
                }) => {
                    let inside = [module, &[ident.to_string()]].concat();
                    self.add(file, &inside, inner, paths);
                }
                syn::Item::Use(item) => {
                    imported(&item.tree, &mut Vec::new(), &mut |path, name| {
                        // A re-export is not a use.
                        if matches!(item.vis, syn::Visibility::Inherited) {
                            written.0.push(path.clone());
                        }
                        match name {
                            Some(name) => drop(names.imported.insert(name, path)),
                            // Globs of other crates are ignored.
                            None if ["crate", "self", "super"].contains(&path[0].as_str()) => {
                                names.globs.push(path)
                            }
                            None => {}
                        }
                    });
                }
                item => {
                    names.defined.extend(name_of(item));
                    written.visit_item(item);
                }
            }
        }
        paths.extend(
            written
                .0
                .into_iter()
                .map(|path| (file.to_owned(), module.to_vec(), path)),
        );
        // Of a module with several cfgs, the first counts.
        self.modules.entry(module.to_vec()).or_insert(names);
    }

    /// The file that defines what `path` means in `module`.
    fn file_of(&self, module: &[String], path: &[String], depth: usize) -> Option<PathBuf> {
        assert!(depth < 16, "{module:?}: {path:?} cannot be resolved");
        let (first, rest) = path.split_first()?;
        match first.as_str() {
            name if name == "crate" || name == self.name => return self.below(&[], rest, depth),
            "self" => return self.below(module, rest, depth),
            "super" => return self.file_of_or_below(&module[..module.len() - 1], rest, depth),
            _ => {}
        }
        let names = self.modules.get(module)?;
        let is_known = names.defined.contains(first)
            || names.imported.contains_key(first)
            || self
                .modules
                .contains_key(&[module, std::slice::from_ref(first)].concat())
            || !names.globs.is_empty();
        if is_known {
            self.below(module, path, depth)
        } else {
            None
        }
    }

    /// Resolves what follows a `super`, which may be another `super`.
    fn file_of_or_below(
        &self,
        module: &[String],
        path: &[String],
        depth: usize,
    ) -> Option<PathBuf> {
        match path.first().is_some_and(|first| first == "super") {
            true => self.file_of(module, path, depth),
            false => self.below(module, path, depth),
        }
    }

    /// The file that defines `path` within `module`.
    fn below(&self, module: &[String], path: &[String], depth: usize) -> Option<PathBuf> {
        let (first, rest) = path.split_first()?;
        let child = [module, std::slice::from_ref(first)].concat();
        let names = self.modules.get(module)?;
        if names.defined.contains(first) {
            return Some(names.file.clone());
        }
        if self.modules.contains_key(&child) {
            return self.below(&child, rest, depth);
        }
        // Not an item with the name of its crate, such as anyhow.
        if let Some(origin) = names
            .imported
            .get(first)
            .filter(|origin| origin[0] != *first)
        {
            return self.file_of(module, &[origin, rest].concat(), depth + 1);
        }
        names
            .globs
            .iter()
            .find_map(|origin| self.file_of(module, &[origin, path].concat(), depth + 1))
    }
}

/// Every path that is written in the visited items.
#[derive(Default)]
struct Written(Vec<Vec<String>>);

impl<'ast> Visit<'ast> for Written {
    fn visit_path(&mut self, path: &'ast syn::Path) {
        self.0.push(
            path.segments
                .iter()
                .map(|segment| segment.ident.to_string())
                .collect(),
        );
        visit::visit_path(self, path);
    }

    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        imported(&item.tree, &mut Vec::new(), &mut |path, _| {
            self.0.push(path)
        });
    }

    fn visit_macro(&mut self, item: &'ast syn::Macro) {
        // Arguments that are expressions between commas, as of `format!`, `assert!` and `vec!`. Others are skipped.
        let expressions =
            item.parse_body_with(Punctuated::<syn::Expr, syn::Token![,]>::parse_terminated);
        for expression in expressions.into_iter().flatten() {
            let mut inside = Written::default();
            inside.visit_expr(&expression);
            self.0.append(&mut inside.0);
        }
        visit::visit_macro(self, item);
    }

    fn visit_item(&mut self, item: &'ast syn::Item) {
        if !is_of_tests(item) {
            visit::visit_item(self, item);
        }
    }
}

/// Calls `tell` with the path and the local name of everything that a `use` imports. A glob has no name.
fn imported(
    tree: &syn::UseTree,
    before: &mut Vec<String>,
    tell: &mut dyn FnMut(Vec<String>, Option<String>),
) {
    match tree {
        syn::UseTree::Path(part) => {
            before.push(part.ident.to_string());
            imported(&part.tree, before, tell);
            before.pop();
        }
        syn::UseTree::Group(group) => group
            .items
            .iter()
            .for_each(|tree| imported(tree, before, tell)),
        syn::UseTree::Name(part) if part.ident == "self" => {
            tell(before.clone(), before.last().cloned())
        }
        syn::UseTree::Name(part) => {
            let name = part.ident.to_string();
            tell(
                [&before[..], std::slice::from_ref(&name)].concat(),
                Some(name),
            );
        }
        syn::UseTree::Rename(part) => {
            tell(
                [&before[..], &[part.ident.to_string()]].concat(),
                Some(part.rename.to_string()),
            );
        }
        _ => tell(before.clone(), None),
    }
}

/// The name that an item defines in its module.
fn name_of(item: &syn::Item) -> Option<String> {
    let ident = match item {
        syn::Item::Const(item) => &item.ident,
        syn::Item::Enum(item) => &item.ident,
        syn::Item::Fn(item) => &item.sig.ident,
        syn::Item::Macro(item) => item.ident.as_ref()?,
        syn::Item::Static(item) => &item.ident,
        syn::Item::Struct(item) => &item.ident,
        syn::Item::Trait(item) => &item.ident,
        syn::Item::Type(item) => &item.ident,
        syn::Item::Union(item) => &item.ident,
        _ => return None,
    };
    Some(ident.to_string())
}

pub(super) fn is_of_tests(item: &syn::Item) -> bool {
    let attributes = match item {
        syn::Item::Fn(item) => &item.attrs,
        syn::Item::Mod(item) => &item.attrs,
        syn::Item::Use(item) => &item.attrs,
        _ => return false,
    };
    attributes.iter().any(|attribute| match &attribute.meta {
        syn::Meta::List(list) => list.path.is_ident("cfg") && list.tokens.to_string() == "test",
        _ => false,
    })
}

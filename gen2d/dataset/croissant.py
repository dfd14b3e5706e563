"""The Croissant description of a dataset for search engines, from the manifest."""

from typing import Any

from gen2d.core.schema import Field
from gen2d.dataset.manifest import Manifest, as_bytes
from gen2d.dataset.spec import MANIFEST
from gen2d.storage.sealed import as_json, sha256


def croissant(manifest: Manifest) -> bytes:
    """The dataset in Croissant 1.0 (https://docs.mlcommons.org/croissant/docs/croissant-spec.html), as JSON.

    The shards are one set of files, however many there are; the tables that the manifest names have their checksums.
    """
    content = as_bytes(manifest)
    description = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": manifest.name,
        "description": "Rendered videos of two-dimensional rigid bodies with full ground truth, made by gen2d.",
        "license": manifest.licence,
        "version": "1.0.0",
        "variableMeasured": [_variable(name, field) for name, field in manifest.fields.items()],
        "distribution": [
            {
                "@type": "cr:FileObject",
                "@id": MANIFEST,
                "name": MANIFEST,
                "contentUrl": MANIFEST,
                "encodingFormat": "application/json",
                "contentSize": f"{len(content)} B",
                "sha256": sha256(content),
            },
            {
                "@type": "cr:FileSet",
                "@id": "shard-files",
                "name": "shard-files",
                "description": "HDF5 files, each with consecutive videos of one split, in SPLIT-NUMBER.h5.",
                "encodingFormat": "application/x-hdf5",
                "includes": "shards/*.h5",
            },
        ],
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": "tables",
                "name": "tables",
                "description": "For each split the table of its shards, which has the checksum of every file.",
                "field": [_column(name, kind) for name, kind in _COLUMNS.items()],
            }
        ],
    }
    return as_json(description)


_COLUMNS = {"file": "sc:Text", "sha256": "sc:Text", "shards": "sc:Integer", "bytes": "sc:Integer"}


def _column(name: str, kind: str) -> dict[str, Any]:
    source = {"fileObject": {"@id": MANIFEST}, "extract": {"jsonPath": f"$.tables.*.{name}"}}
    return {"@type": "cr:Field", "@id": f"tables/{name}", "name": name, "dataType": kind, "source": source}


def _variable(name: str, field: Field) -> dict[str, Any]:
    kind = {"valueReference": "sc:Text"} if field.is_text else {}
    return {"@type": "sc:PropertyValue", "name": name, "unitText": field.unit, "description": field.meaning, **kind}


# Croissant's names from its own and other vocabularies.
_NAMES = ("extract", "field", "fileObject", "fileSet", "includes", "jsonPath", "recordSet", "source")
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
} | {name: f"cr:{name}" for name in _NAMES}

"""Campaigns of small experiments."""

import yaml

from tests.support.experiments import small


def described(folder, **keys):
    """A campaign of small points in a file, with its base beside it."""
    base = small("base")
    base["render"] = {"samples_per_beam": 2, "max_order": 1}
    base["retrieval"] = {"methods": ["cc"], "stride": 8, "sources": "measured"}
    (folder / "base.yaml").write_text(yaml.safe_dump(base))
    path = folder / f"{keys.get('name', 'test')}.yaml"
    path.write_text(yaml.safe_dump({"name": "test", "base": "base.yaml", "seed": 1} | keys))
    return path

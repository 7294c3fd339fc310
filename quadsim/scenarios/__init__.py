"""The application: from a scenario file to a flight, its verdict and its products.

Read first: `loading` (a name or path to a `schema` scenario), `assembly` (its plant, controller and course), `rollout`
(the flight), `flown` (what came of it).  `commands/` is the command line, `courses/` the references, `library/` the
data.  The other folders are rooms, features that can be taken away: campaign, design, export, gym, identify, live and
papers.
"""

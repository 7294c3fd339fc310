/* What the library was compiled from: quadsim/core/build.py defines this text, and looks for it in the file. */
extern const char quadsim_sources[];
const char quadsim_sources[] = QUADSIM_SOURCES;

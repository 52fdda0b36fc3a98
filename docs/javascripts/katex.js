// Formulas between $ signs, on every page that is shown. KaTeX lies beside this file where the site was built with npm at hand
// (benchmarks/site.py); elsewhere it comes from the net, and without a net formulas are shown as they are written.
const beside = new URL("katex/", document.currentScript.src).href;
const elsewhere = "https://unpkg.com/katex@0.16.22/dist/";
const loaded = (src) =>
  new Promise((done, failed) => {
    const script = Object.assign(document.createElement("script"), { src, onload: done, onerror: failed });
    document.head.append(script);
  });
const katexFrom = async (folder) => {
  await loaded(`${folder}katex.min.js`);
  await loaded(`${folder}contrib/auto-render.min.js`);
  document.head.append(
    Object.assign(document.createElement("link"), { rel: "stylesheet", href: `${folder}katex.min.css` }),
  );
};
const katexReady = katexFrom(beside).catch(() => katexFrom(elsewhere));
document$.subscribe(({ body }) =>
  katexReady.then(
    () =>
      renderMathInElement(body, {
        delimiters: [
          { left: "$$", right: "$$", display: true },
          { left: "$", right: "$", display: false },
          { left: "\\(", right: "\\)", display: false },
          { left: "\\[", right: "\\]", display: true },
        ],
      }),
    () => console.warn("KaTeX could not be loaded; formulas are shown as they are written"),
  ),
);

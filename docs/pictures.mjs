// Take pictures of a page in Chromium, with Playwright. The argument is a file of JSON: {playwright, chromium, url, size,
// isReady, shots}. Each shot is {script, path}: a script runs in the page, and the picture of the window goes to the path.

import { createRequire } from "node:module";
import { readFileSync } from "node:fs";

const job = JSON.parse(readFileSync(process.argv[2], "utf-8"));
const { chromium } = createRequire(import.meta.url)(job.playwright);
const args = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars"];
const browser = await chromium.launch({ executablePath: job.chromium, args });
const [width, height] = job.size;
const page = await browser.newPage({ viewport: { width, height }, bypassCSP: true });
page.setDefaultTimeout(300_000);
await page.goto(job.url);
await page.waitForFunction(job.isReady);
const nextFrame = () => new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)));
for (const { script, path } of job.shots) {
  await page.evaluate(script);
  await page.evaluate(nextFrame);
  await page.screenshot({ path });
}
await browser.close();
